function rays_to_table(rays, file)
%RAYS_TO_TABLE Ray table of the rays of MATLAB's ray tracing.
%   RAYS_TO_TABLE(RAYS, FILE) writes the output of raytrace(tx, rx), a cell array of comm.Ray objects with a row for
%   each transmitter and a column for each receiver, as a CSV ray table, which calibray.read_rays reads
%   (docs/reference/ray-table.md). Structures with the fields of comm.Ray are also accepted.
%
%   The power of a ray is -PathLoss, which includes no antenna gains. Positions are in MATLAB's Cartesian frame, in
%   metres: use Cartesian rays. Interactions keep their type and, if MATLAB states it, the name of their material.
if ~iscell(rays)
    error('rays_to_table:input', 'rays must be a cell array as raytrace gives it; put a single array of rays into {}');
end
[out, reason] = fopen(file, 'w');
if out < 0
    error('rays_to_table:file', '%s cannot be written: %s', file, reason);
end
closing = onCleanup(@() fclose(out));
fprintf(out, 'path,point,type,x,y,z,material,link,power_db,delay\n');
path = 0;
for t = 1:size(rays, 1)
    for r = 1:size(rays, 2)
        found = rays{t, r};
        for k = 1:numel(found)
            path = path + 1;
            write_path(out, found(k), path, sprintf('%d-%d', t, r));
        end
    end
end
if path == 0
    error('rays_to_table:empty', 'there is no ray between any transmitter and receiver; raise MaxNumReflections');
end
end

function write_path(out, ray, path, link)
if strcmpi(char(ray.CoordinateSystem), 'Geographic')
    error('rays_to_table:coordinates', 'rays are geographic; trace in a Cartesian siteviewer, in the frame of the scene');
end
points = ray.TransmitterLocation(:)';
types = {'transmitter'};
materials = {''};
if ~ray.LineOfSight
    for k = 1:numel(ray.Interactions)
        hit = ray.Interactions(k);
        points(end + 1, :) = hit.Location(:)';
        types{end + 1} = lower(char(hit.Type));
        materials{end + 1} = '';
        if isfield(hit, 'MaterialName') || isprop(hit, 'MaterialName')
            materials{end} = char(hit.MaterialName);
        end
    end
end
points(end + 1, :) = ray.ReceiverLocation(:)';
types{end + 1} = 'receiver';
materials{end + 1} = '';
for k = 1:numel(types)
    fprintf(out, '%d,%d,%s,%.12g,%.12g,%.12g,%s,%s,%.12g,%.12g\n', path, k - 1, types{k}, points(k, :), materials{k}, ...
        link, -ray.PathLoss, ray.PropagationDelay);
end
end
