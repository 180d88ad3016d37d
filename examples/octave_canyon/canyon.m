function canyon(request_file, response_file, walls)
  % Path loss in a straight street canyon by the image method: the direct path and one reflection each off the ground
  % and both walls. The code runs in MATLAB and GNU Octave 7 or later. Its files: docs/reference/program-files.md.
  % With 'half-space' as the third argument, surfaces are half-spaces: nothing is reflected from their rear face.
  request = jsondecode(fileread(request_file));
  if ~strcmp(request.schema, 'calibray.request') || request.version ~= 1
    error('%s version %d: this program reads calibray.request version 1', request.schema, request.version);
  end
  if strcmp(request.combining, 'band')
    error('combining = "band" is not programmed; use "power" or "coherent"');
  end
  if ~strcmp(request.antennas.tx.pattern, 'iso') || ~strcmp(request.antennas.rx.pattern, 'iso')
    error('only isotropic antennas are programmed');
  end
  loss = path_loss(request, nargin > 2 && strcmp(walls, 'half-space'));
  if any(isnan(loss))
    error('path loss of link %d is not a number', find(isnan(loss), 1));  % jsonencode would write null: no path
  end
  file = fopen(response_file, 'w');
  fprintf(file, '%s', jsonencode(struct('path_loss_db', loss)));
  fclose(file);
end

function loss = path_loss(request, simple)
  % Path loss of every link [dB]; +Inf if it has no path.
  wavelength = 299792458 / request.frequency;
  planes = {  % point, normal into the street, material
    [0 0 0], [0 0 1], 'ground'
    [0 -10 0], [0 1 0], 'walls'
    [0 10 0], [0 -1 0], 'walls'};
  count = size(request.links.tx, 1);
  loss = zeros(count, 1);
  for link = 1:count
    tx = request.links.tx(link, :);
    rx = request.links.rx(link, :);
    gains = direct(tx, rx, wavelength);
    for k = 1:size(planes, 1)
      material = find_material(request.materials, planes{k, 3});
      gains(end + 1) = reflected(tx, rx, planes{k, 1}, planes{k, 2}, material, request.frequency, wavelength, simple);
    end
    if strcmp(request.combining, 'coherent')
      power = abs(sum(gains))^2;
    else
      power = sum(abs(gains).^2);
    end
    loss(link) = -10 * log10(power);
  end
end

function gain = direct(tx, rx, wavelength)
  distance = norm(rx - tx);
  k = (rx - tx) / distance;
  gain = propagation(distance, wavelength) * dot(vertical(k), vertical(k));
end

function gain = reflected(tx, rx, point, normal, material, frequency, wavelength, simple)
  image = tx - 2 * dot(tx - point, normal) * normal;  % image source of the transmitter
  distance = norm(rx - image);
  out = (rx - image) / distance;                       % direction after the reflection
  in = out - 2 * dot(out, normal) * normal;            % direction before it
  [te, tm] = slab(-dot(in, normal), material, frequency, wavelength, simple);
  across = cross(in, normal);
  if norm(across) < 1e-12
    across = cross(in, [1 0 0] + [0 1 0] * (abs(in(1)) > 0.9));
  end
  across = across / norm(across);                      % perpendicular to the plane of incidence
  field = vertical(in);
  field = te * dot(field, across) * across + tm * dot(field, cross(across, in)) * cross(across, out);
  gain = propagation(distance, wavelength) * sum(vertical(out) .* field);
end

function [te, tm] = slab(cosine, material, frequency, wavelength, simple)
  % ITU-R P.2040-3: complex permittivity eq. 9, single interface eq. 37, slab eq. 43 and 44.
  vacuum_permittivity = 8.8541878128e-12;
  eta = material.relative_permittivity - 1j * material.conductivity / (2 * pi * frequency * vacuum_permittivity);
  root = sqrt(eta - (1 - cosine^2));
  q = 2 * pi * material.thickness / wavelength * root;
  single = [(cosine - root) / (cosine + root), (eta * cosine - root) / (eta * cosine + root)];
  twice = exp(-2j * q) * ~simple;
  both = single .* (1 - twice) ./ (1 - single.^2 * twice);
  te = both(1);
  tm = both(2);
end

function value = propagation(distance, wavelength)
  value = wavelength / (4 * pi * distance) * exp(-2j * pi * distance / wavelength);
end

function e = vertical(k)
  % Field of a vertically polarized isotropic antenna in direction k.
  e = [k(1) * k(3), k(2) * k(3), -(k(1)^2 + k(2)^2)];
  e = e / norm(e);
end

function material = find_material(materials, name)
  index = find(strcmp({materials.name}, name));
  if isempty(index)
    error('the scene has no material %s', name);
  end
  material = materials(index);
end
