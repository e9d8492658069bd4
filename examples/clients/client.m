% A robot's side of `pcr-mpc serve` in MATLAB (R2020b or later). Untested: written from the packet's description.
host = "127.0.0.1"; port = 5005; n = 2; period = 0.01;
p = [0 0.25]; q = [3.366835 -0.225243];  % your sensors [m], [rad]; here a tip that stays
wire = udpport("datagram", "IPV4", "Timeout", period);
commandSize = 24 + 8 * (1 + 2 * n) + 4;
for k = 0:9
    body = [uint8(['PCR' 1]), bytes(uint16(1)), uint8([1 n]), bytes(uint32(k)), bytes(period * k), bytes([p q])];
    write(wire, [body, bytes(crc32(body))], "uint8", host, port);
    pause(period);
    while wire.NumDatagramsAvailable > 0
        data = uint8(read(wire, 1, "uint8").Data);
        if numel(data) ~= commandSize || ~isequal(data(end-3:end), bytes(crc32(data(1:end-4)))) ...
                || ~isequal(data(1:8), [uint8(['PCR' 1]), bytes(uint16(1)), uint8([2 n])])
            continue
        end
        if typecast(data(9:12), "uint32") == k
            u = typecast(data(25:24 + 8 * n), "double");
            fprintf("%d rung %d rates %g %g\n", k, data(21), u(1), u(2));
            q = q + period * u;
        end
    end  % no answer: keep the last rates for a few periods, then stop by yourself
end

function b = bytes(x)  % little-endian on every machine that MATLAB runs on
    b = typecast(x, "uint8");
end

function c = crc32(data)  % as zlib's
    c = uint32(4294967295);
    for d = data
        c = bitxor(c, uint32(d));
        for bit = 1:8
            c = bitxor(bitshift(c, -1), uint32(3988292384) * bitand(c, uint32(1)));
        end
    end
    c = bitcmp(c);
end
