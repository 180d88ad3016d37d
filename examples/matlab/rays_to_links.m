function [links, paths] = rays_to_links(rays, folder)
%RAYS_TO_LINKS Tables of links and paths from the rays of MATLAB's ray tracing.
%   [LINKS, PATHS] = RAYS_TO_LINKS(RAYS) takes the output of raytrace(tx, rx): a cell array of comm.Ray objects with a
%   row for each transmitter and a column for each receiver. LINKS has a structure for each pair with a ray, PATHS
%   one for each ray. Structures with the fields of comm.Ray are also accepted, so Octave can read rays that MATLAB
%   has saved.
%
%   RAYS_TO_LINKS(RAYS, FOLDER) writes them to links.csv, which Calibray reads as a table of links, and to paths.csv.
%
%   The path loss of a link [dB] sums the powers of its rays, like objective.combining = "power". Angles are in degrees,
%   as in comm.Ray: azimuth from the x axis (or east) towards y (or north), elevation from the horizon. Geographic rays
%   give columns of latitude and longitude [deg] and height [m]; the study then needs position = "geographic".
if ~iscell(rays)
    error('rays_to_links:input', 'rays must be a cell array as raytrace gives it; put a single array of rays into {}');
end
links = [];
paths = [];
for t = 1:size(rays, 1)
    for r = 1:size(rays, 2)
        found = rays{t, r};
        if isempty(found)
            continue
        end
        link = ends_of(found(1));
        link.transmitter = t;
        link.receiver = r;
        link.path_loss_db = -10 * log10(sum(10 .^ (-[found.PathLoss] / 10)));
        link.num_rays = numel(found);
        links = [links; link];
        for k = 1:numel(found)
            paths = [paths; path_of(found(k), t, r)];
        end
    end
end
if isempty(links)
    error('rays_to_links:empty', 'there is no ray between any transmitter and receiver; raise MaxNumReflections');
end
if nargin > 1
    write_table(links, fullfile(folder, 'links.csv'));
    write_table(paths, fullfile(folder, 'paths.csv'));
end
end

function link = ends_of(ray)
if strcmpi(char(ray.CoordinateSystem), 'Geographic')
    names = {'latitude', 'longitude', 'height'};
else
    names = {'x', 'y', 'z'};
end
for k = 1:3
    link.(['tx_' names{k}]) = ray.TransmitterLocation(k);
end
for k = 1:3
    link.(['rx_' names{k}]) = ray.ReceiverLocation(k);
end
end

function path = path_of(ray, t, r)
path.transmitter = t;
path.receiver = r;
path.path_loss_db = ray.PathLoss;
path.phase_shift_rad = ray.PhaseShift;
path.delay_s = ray.PropagationDelay;
path.departure_azimuth_deg = ray.AngleOfDeparture(1);
path.departure_elevation_deg = ray.AngleOfDeparture(2);
path.arrival_azimuth_deg = ray.AngleOfArrival(1);
path.arrival_elevation_deg = ray.AngleOfArrival(2);
path.frequency_hz = ray.Frequency;
path.interactions = 0;
if ~ray.LineOfSight
    path.interactions = ray.NumInteractions;
end
end

function write_table(rows, file)
[out, reason] = fopen(file, 'w');
if out < 0
    error('rays_to_links:file', '%s cannot be written: %s', file, reason);
end
names = fieldnames(rows);
fprintf(out, '%s\n', strjoin(names', ','));
for k = 1:numel(rows)
    values = cellfun(@(name) sprintf('%.12g', rows(k).(name)), names', 'UniformOutput', false);
    fprintf(out, '%s\n', strjoin(values, ','));
end
fclose(out);
end
