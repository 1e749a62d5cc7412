-- Shows the datagrams of `scanhub gateway` in Wireshark and tshark: every field by its name, checksums and MACs checked, gaps,
-- duplicates and datagrams out of order flagged per hub, epoch, sensor and topic. docs/datagram.md has the bytes.
--
--   tshark -X lua_script:scanhub.lua -f 'udp port 22200' -Y scanhub.lost
--   tshark -X lua_script:scanhub.lua -o scanhub.key_file:KEY -Y 'scanhub.mac_status == "wrong"'
--
-- or copy it to where Help, About, Folders shows the personal Lua plugins.

local PORT = 22200
local WINDOW = 1024

local scanhub = Proto("scanhub", "scanhub LAN")
scanhub.prefs.crc = Pref.bool("Check checksums", true, "Bytes by bytes in Lua: off for long captures")

scanhub.prefs.key_file = Pref.string("Key file", "", "Of `scanhub key new`: 32 bytes, or 64 hex digits")

local TOPICS = {
    [0] = "announce", "telegram", "scan", "marks", "zones", "foreground", "background", "status", "lines", "motion", "early", "tracks", "events", "tilt", "cloud", "obstacles"
}
local VERDICTS = { [0] = "clear", "slow", "stop", "unknown" }
local STATES = { [0] = "absent", "probing", "switching", "starting", "streaming", "silent", "paused" }
local TRACK_STATES = { [0] = "tentative", "confirmed", "hidden", "between_rooms" }
local EVENTS = { [0] = "appeared", "left", "door" }
local POINT_CLASSES = { [0] = "unknown", "background", "foreground", "behind" }
local FAMILIES = { [0] = "lms", "ld", "rplidar" }
-- Of families that send packets: how many bytes one has.
local PACKET = { 47 }
local CODES = { [0] = "not_measured", "no_return", "beyond", "too_near", "too_bright", "weak", "overflow", "error" }
-- From the greatest value of an LMS's measuring mode down.
local OF_LMS = { [0] = "no_return", [1] = "too_bright", [4] = "weak", [5] = "error", [8] = "beyond" }
local COUNTERS = {
    "bytes_read", "bytes_in_telegrams", "bytes_acknowledge", "bytes_discarded", "bytes_buffered", "telegrams",
    "suspect", "aborted", "resyncs", "reconnects", "lost_in_restart", "wakeups", "loan_failed", "rejected_address",
    "rejected_length", "rejected_command", "rejected_count", "rejected_crc", "rejected_vetoed",
    "rejected_superseded", "line_errors", "bytes_damaged", "damaged_ppm", "due_on_line", "lost_on_line", "lost_ppm",
    "scanner_restarts",
}

-- Fields -----------------------------------------------------------------------------------------------------------

local f = {}

-- Declares field `scanhub.NAME`; `kind` is a constructor of ProtoField.
local function field(name, kind, label, ...)
    f[name] = ProtoField[kind]("scanhub." .. name, label, ...)
end

field("magic", "string", "Magic")
field("version", "uint8", "Version")
field("header_length", "uint8", "Header length")
field("topic", "uint8", "Topic", base.DEC, TOPICS)
field("flags", "uint8", "Flags", base.HEX)
field("flags.authenticated", "uint8", "Authenticated", base.DEC, nil, 1)
field("flags.simulated", "uint8", "Simulated", base.DEC, nil, 2)
field("flags.replayed", "uint8", "Replayed", base.DEC, nil, 4)
field("flags.stamp_estimated", "uint8", "Stamp estimated", base.DEC, nil, 8)
field("flags.suspect", "uint8", "Suspect", base.DEC, nil, 16)
field("hub", "uint64", "Hub", base.HEX)
field("epoch", "uint32", "Epoch")
field("sequence", "uint32", "Sequence")
field("stamp_ns", "uint64", "Stamp, ns since 1970")
field("stamp", "absolute_time", "Stamp", base.UTC)
field("sensor", "uint8", "Sensor")
field("part", "uint8", "Part, from 0")
field("parts", "uint8", "Parts of the sample")
field("family", "uint8", "Family", base.DEC, FAMILIES)
field("sensor_name", "string", "Sensor's name")
field("payload_length", "uint16", "Payload length")
field("revision", "uint16", "Payload revision")
field("counter", "uint32", "Scan counter")
field("crc", "uint32", "CRC-32C", base.HEX)
field("crc_status", "string", "Checksum")
field("later", "bytes", "Of a later version")
field("mac", "bytes", "MAC")
field("mac_status", "string", "MAC is")
field("refused", "string", "Refused")
field("lost", "uint32", "Lost before this one")
field("duplicate", "uint32", "Duplicate: this many places below the highest")
field("reordered", "uint32", "Out of order: this many places below the highest")
field("stale", "uint32", "Stale: this many places below the highest")
field("retired", "uint32", "Of a retired epoch; the latest is")

field("announce.boot", "uint64", "Hub's life", base.HEX)
field("announce.sensor", "string", "Sensor's name")
field("announce.type", "string", "Sensor's type")
field("announce.topic", "uint8", "Topic", base.DEC, TOPICS)
field("announce.group", "uint8", "Group 239.255.76")
field("announce.port", "uint16", "Port")
field("announce.next", "uint32", "Next sequence")

field("telegram", "bytes", "Telegram")
field("telegram.packets", "uint16", "Packets")
field("telegram.packet", "bytes", "Packet")

field("scan.first_angle", "double", "First angle, rad, 0 ahead")
field("scan.step", "double", "Step, rad")
field("scan.spacing", "float", "Between two points of the sensor, rad")
field("scan.beam_time_ns", "uint32", "From beam to beam, ns")
field("scan.first_beam_ns", "int32", "First beam after the stamp, ns")
field("scan.unit_um", "uint32", "Micrometres per unit")
field("scan.count", "uint16", "Beams")
field("scan.valid_to", "uint16", "Greatest range")
field("scan.no_return", "uint16", "Code of no return")
field("scan.beyond", "uint16", "Code of beyond the range limit")
field("scan.collapsed", "uint16", "Points that found their beam taken")
field("scan.family", "uint8", "Family", base.DEC, FAMILIES)
field("scan.incomplete", "uint8", "Incomplete", base.DEC, nil, 1)
field("scan.contents", "uint8", "Arrays", base.HEX)
field("scan.intensity_bits", "uint8", "Bits of intensity")
field("scan.turns", "uint8", "Turns")
field("scan.turn_ns", "uint32", "Time of a turn, ns")
field("scan.angle", "float", "Exact angle, rad")
field("scan.range", "uint16", "Range, device units")
field("scan.code", "string", "No reading")
field("scan.intensity", "uint16", "Intensity")
field("scan.upper", "uint8", "Upper bits")

field("marks.count", "uint8", "Marks")
field("marks.overflow", "uint8", "Overflow", base.DEC, nil, 1)
field("marks.unavailable", "uint8", "Unavailable", base.DEC, nil, 2)
field("marks.angle_mdeg", "int32", "Angle, 1/1000 degree, 0 ahead")
field("marks.range_dmm", "uint32", "Range, 1/10 mm")
field("marks.weight", "uint16", "Weight")
field("marks.peak", "uint8", "Peak")
field("marks.edge", "uint8", "Edge")
field("marks.first_beam", "uint16", "First beam")
field("marks.last_beam", "uint16", "Last beam")

field("lines.overflow", "uint8", "Overflow", base.DEC, nil, 1)
field("lines.readings", "uint16", "Beams with a range")
field("lines.on_lines", "uint16", "Beams on a line")
field("lines.noise_m", "float", "Deviation of a range, m")
field("lines.x1_m", "float", "First end x, m")
field("lines.y1_m", "float", "First end y, m")
field("lines.x2_m", "float", "Last end x, m")
field("lines.y2_m", "float", "Last end y, m")
field("lines.r_m", "float", "r, m")
field("lines.alpha_rad", "float", "alpha, rad")
field("lines.sd_r_m", "float", "Deviation of r, m")
field("lines.sd_alpha_rad", "float", "Deviation of alpha, rad")
field("lines.first", "uint16", "First beam")
field("lines.last", "uint16", "Last beam")
field("lines.points", "uint16", "Points")
field("lines.x_m", "float", "Corner x, m")
field("lines.y_m", "float", "Corner y, m")
field("lines.first_line", "uint16", "Of line")
field("lines.second_line", "uint16", "And line")
field("motion.x_m", "double", "x since the start, m")
field("motion.y_m", "double", "y since the start, m")
field("motion.yaw_rad", "double", "Yaw since the start, rad")
field("motion.dx_m", "float", "Step x, m")
field("motion.dy_m", "float", "Step y, m")
field("motion.dyaw_rad", "float", "Step yaw, rad")
field("motion.covariance", "float", "Covariance")
field("motion.overlap", "float", "Overlap")
field("motion.method", "uint8", "Method")
field("motion.valid", "uint8", "Sum is valid")
field("motion.degenerate", "uint8", "Degenerate", base.DEC, nil, 1)
field("motion.breaks", "uint16", "Steps refused")
field("motion.pose_covariance", "float", "Covariance of the sum")

field("early.verdict", "uint8", "Verdict", base.DEC, VERDICTS)
field("early.withdrawn", "uint8", "Withdrawn", base.DEC, nil, 1)
field("early.beam", "uint16", "Nearest beam so far")
field("early.distance_mm", "uint32", "Its distance, mm")
field("early.bytes_seen", "uint16", "Bytes that had arrived")
field("early.beams_seen", "uint16", "Beams that had arrived")

field("tracks.name", "string", "Sensor")
field("tracks.site_x_m", "float", "Its x, m")
field("tracks.site_y_m", "float", "Its y, m")
field("tracks.yaw_rad", "float", "Its yaw, rad")
field("tracks.upside_down", "uint8", "It hangs upside down")
field("tracks.id", "uint64", "Person")
field("tracks.x_m", "float", "x, m")
field("tracks.y_m", "float", "y, m")
field("tracks.vx_m_s", "float", "Speed along x, m/s")
field("tracks.vy_m_s", "float", "Speed along y, m/s")
field("tracks.covariance", "float", "Covariance, m2")
field("tracks.score", "float", "Score")
field("tracks.age_ms", "uint32", "Age, ms")
field("tracks.sensors", "uint32", "Sensors that see him")
field("tracks.room", "string", "Room")
field("tracks.state", "uint8", "State", base.DEC, TRACK_STATES)

field("events.id", "uint64", "Person")
field("events.kind", "uint8", "Kind", base.DEC, EVENTS)
field("events.room", "string", "Room")
field("events.door", "string", "Door")
field("events.from", "string", "From")
field("events.to", "string", "To")

field("tilt.angle_rad", "double", "Angle, rad")
field("tilt.rate_rad_s", "double", "Rate, rad/s")

field("cloud.sweep", "uint32", "Sweep")
field("cloud.generation", "uint32", "Generation")
field("cloud.first", "uint8", "First of the sweep", base.DEC, nil, 1)
field("cloud.last", "uint8", "Last of the sweep", base.DEC, nil, 2)
field("cloud.complete", "uint8", "Complete", base.DEC, nil, 4)
field("cloud.doubted", "uint8", "Doubted", base.DEC, nil, 8)
field("cloud.x_m", "float", "x, m")
field("cloud.y_m", "float", "y, m")
field("cloud.z_m", "float", "z, m")
field("cloud.beam", "uint16", "Beam")
field("cloud.class", "uint8", "Class", base.DEC, POINT_CLASSES)

field("obstacles.sweep", "uint32", "Sweep")
field("obstacles.generation", "uint32", "Generation")
field("obstacles.left_out", "uint32", "Left out")
field("obstacles.complete", "uint8", "Complete", base.DEC, nil, 4)
field("obstacles.doubted", "uint8", "Doubted", base.DEC, nil, 8)
field("obstacles.x_m", "float", "x, m")
field("obstacles.y_m", "float", "y, m")
field("obstacles.z_m", "float", "z, m")
field("obstacles.low_m", "float", "Least, m")
field("obstacles.high_m", "float", "Greatest, m")
field("obstacles.distance_m", "float", "Distance, m")
field("obstacles.points", "uint32", "Points")
field("obstacles.foreground", "uint8", "Foreground", base.DEC, nil, 1)
field("obstacles.near", "uint8", "Near", base.DEC, nil, 2)

field("zones.verdict", "uint8", "Verdict", base.DEC, VERDICTS)
field("zones.count", "uint8", "Zones")
field("zones.nearest_beam", "uint16", "Nearest beam")
field("zones.nearest_mm", "uint32", "Nearest, mm")
field("zones.invalid_beams", "uint16", "Invalid beams")
field("zones.provisional", "uint8", "Provisional", base.DEC, nil, 1)
field("zones.radius_mm", "uint16", "Radius, mm")
field("zones.beams", "uint16", "Beams inside")
field("zones.violated", "uint8", "Violated")

field("foreground.generation", "uint32", "Generation")
field("foreground.count", "uint16", "Beams of the scan")
field("foreground.beams", "uint16", "Beams in the foreground")
field("foreground.unit_um", "uint32", "Micrometres per unit")
field("foreground.left_out", "uint16", "Segments left out")
field("foreground.segments", "uint16", "Segments")
field("foreground.set", "bytes", "Beams, a bit each")
field("foreground.beam", "uint16", "Beam")
field("foreground.range", "uint16", "Range, device units")
field("foreground.first", "uint16", "First beam")
field("foreground.last", "uint16", "Last beam")
field("foreground.nearest", "uint16", "Nearest, device units")
field("foreground.width", "uint16", "Width, device units")
field("foreground.x_mm", "int32", "x, mm")
field("foreground.y_mm", "int32", "y, mm")
field("foreground.support", "uint8", "Supported")

field("background.first_angle", "double", "First angle, rad, 0 ahead")
field("background.step", "double", "Step, rad")
field("background.generation", "uint32", "Generation")
field("background.taught", "uint16", "Beams taught")
field("background.count", "uint16", "Beams")
field("background.unit_um", "uint32", "Micrometres per unit")
field("background.frozen", "uint8", "Frozen", base.DEC, nil, 1)
field("background.range", "uint16", "Range, device units")

field("status.state", "uint8", "State", base.DEC, STATES)
field("status.mode", "uint8", "Measuring mode", base.HEX)
field("status.unit_mm", "uint8", "Millimetres per unit")
field("status.family", "uint8", "Family", base.DEC, FAMILIES)
field("status.baud", "uint32", "Baud rate")
field("status.since_ns", "uint64", "Since, ns of the hub's monotonic clock")
field("status.rate_mhz", "uint32", "Scans per second, 1/1000")
field("status.angle_deg", "uint16", "Field of view, degrees")
field("status.resolution_cdeg", "uint16", "Step, 1/100 degree")
field("status.type", "string", "Type")
field("status.port", "string", "Port")
field("status.last_error", "string", "Last error")
field("status.x_m", "double", "x, m")
field("status.y_m", "double", "y, m")
field("status.yaw_rad", "double", "Yaw, rad")
field("status.upside_down", "uint8", "Upside down")
for _, name in ipairs(COUNTERS) do
    field("status." .. name, "uint64", name)
end

scanhub.fields = {}
for _, declared in pairs(f) do
    table.insert(scanhub.fields, declared)
end

local expert_lost = ProtoExpert.new("scanhub.expert.lost", "datagrams are missing", expert.group.SEQUENCE,
    expert.severity.WARN)
local expert_order = ProtoExpert.new("scanhub.expert.order", "not the next one", expert.group.SEQUENCE,
    expert.severity.NOTE)
local expert_refused = ProtoExpert.new("scanhub.expert.refused", "a receiver refuses it", expert.group.MALFORMED,
    expert.severity.ERROR)
scanhub.experts = { expert_lost, expert_order, expert_refused }

-- Checksum ---------------------------------------------------------------------------------------------------------

-- Lua 5.2 brings bit32, Lua 5.4 has operators that 5.2 cannot parse.
local bits = bit32 or bit or load([[return {
    bxor = function(a, b, c) return a ~ b ~ (c or 0) end, band = function(a, b) return a & b end,
    rshift = function(a, n) return a >> n end, bnot = function(a) return ~a & 0xFFFFFFFF end,
    rrotate = function(a, n) return (a >> n | a << 32 - n) & 0xFFFFFFFF end }]])()

local CRC = {}
for byte = 0, 255 do
    local crc = byte
    for _ = 1, 8 do
        local odd = crc % 2 == 1
        crc = bits.rshift(crc, 1)
        if odd then crc = bits.bxor(crc, 0x82F63B78) end
    end
    CRC[byte] = crc
end

-- CRC-32C of the datagram with its own four bytes as 0.
local function crc_of(tvb)
    local bytes = tvb:bytes()
    local crc = 0xFFFFFFFF
    for i = 0, bytes:len() - 1 do
        local byte = (i < 44 or i > 47) and bytes:get_index(i) or 0
        crc = bits.bxor(bits.rshift(crc, 8), CRC[bits.band(bits.bxor(crc, byte), 0xFF)])
    end
    return bits.bnot(crc) % 0x100000000
end

-- Keys -------------------------------------------------------------------------------------------------------------

-- Of SHA-256 (FIPS 180-4).
local ROUNDS = {
    0x428a2f98, 0x71374491, 0xb5c0fbcf, 0xe9b5dba5, 0x3956c25b, 0x59f111f1, 0x923f82a4, 0xab1c5ed5,
    0xd807aa98, 0x12835b01, 0x243185be, 0x550c7dc3, 0x72be5d74, 0x80deb1fe, 0x9bdc06a7, 0xc19bf174,
    0xe49b69c1, 0xefbe4786, 0x0fc19dc6, 0x240ca1cc, 0x2de92c6f, 0x4a7484aa, 0x5cb0a9dc, 0x76f988da,
    0x983e5152, 0xa831c66d, 0xb00327c8, 0xbf597fc7, 0xc6e00bf3, 0xd5a79147, 0x06ca6351, 0x14292967,
    0x27b70a85, 0x2e1b2138, 0x4d2c6dfc, 0x53380d13, 0x650a7354, 0x766a0abb, 0x81c2c92e, 0x92722c85,
    0xa2bfe8a1, 0xa81a664b, 0xc24b8b70, 0xc76c51a3, 0xd192e819, 0xd6990624, 0xf40e3585, 0x106aa070,
    0x19a4c116, 0x1e376c08, 0x2748774c, 0x34b0bcb5, 0x391c0cb3, 0x4ed8aa4a, 0x5b9cca4f, 0x682e6ff3,
    0x748f82ee, 0x78a5636f, 0x84c87814, 0x8cc70208, 0x90befffa, 0xa4506ceb, 0xbef9a3f7, 0xc67178f2,
}
local BEGIN = {
    0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a, 0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19,
}
local turn, unpack = bits.rrotate or bits.ror, table.unpack or unpack

-- SHA-256 of a string, as one.
local function sha256(text)
    local bxor, band, bnot, rshift = bits.bxor, bits.band, bits.bnot, bits.rshift
    local len = #text
    text = text .. "\128" .. string.rep("\0", (55 - len) % 64) .. "\0\0\0\0"
        .. string.char(math.floor(len / 0x200000) % 256, math.floor(len / 0x2000) % 256, math.floor(len / 32) % 256,
            len * 8 % 256)
    local state = { unpack(BEGIN) }
    local w = {}
    for begin = 1, #text, 64 do
        for i = 1, 16 do
            local a, b, c, d = text:byte(begin + 4 * i - 4, begin + 4 * i - 1)
            w[i] = a * 0x1000000 + b * 0x10000 + c * 0x100 + d
        end
        for i = 17, 64 do
            local x, y = w[i - 15], w[i - 2]
            local first = bxor(turn(x, 7), turn(x, 18), rshift(x, 3))
            local second = bxor(turn(y, 17), turn(y, 19), rshift(y, 10))
            w[i] = (w[i - 16] + first + w[i - 7] + second) % 0x100000000
        end
        local a, b, c, d, e, x, y, z = unpack(state)
        for i = 1, 64 do
            local choice, majority = bxor(band(e, x), band(bnot(e), y)), bxor(band(a, b), band(a, c), band(b, c))
            local first = z + bxor(turn(e, 6), turn(e, 11), turn(e, 25)) + choice + ROUNDS[i] + w[i]
            local second = bxor(turn(a, 2), turn(a, 13), turn(a, 22)) + majority
            a, b, c, d, e, x, y, z = (first + second) % 0x100000000, a, b, c, (d + first) % 0x100000000, e, x, y
        end
        for i, value in ipairs({ a, b, c, d, e, x, y, z }) do state[i] = (state[i] + value) % 0x100000000 end
    end
    local out = {}
    for i, value in ipairs(state) do
        for byte = 3, 0, -1 do out[4 * i - byte] = string.char(math.floor(value / 256 ^ byte) % 256) end
    end
    return table.concat(out)
end

-- The key in a file as the beginnings of the two hashes of a MAC, or nothing and why.
local function read_key(path)
    local file, why = io.open(path, "rb")
    if not file then return nil, why end
    local key = file:read(256) or ""
    file:close()
    local digits = key:match("^(%x+)%s*$")
    if #key ~= 32 and digits and #digits == 64 then
        key = digits:gsub("..", function(pair) return string.char(tonumber(pair, 16)) end)
    end
    if #key ~= 32 then return nil, path .. ": it is no key" end
    local function pad(with)
        return (key .. string.rep("\0", 32)):gsub(".", function(c) return string.char(bits.bxor(c:byte(), with)) end)
    end
    return { inner = (pad(0x36)), outer = (pad(0x5C)) }
end

local key, key_path, no_key

-- Whether the MAC of a datagram, which it may not have, is of the key: `right`, `wrong`, `none`, or why nobody knows.
local function mac_status(tvb, has_mac)
    local path = scanhub.prefs.key_file
    if path ~= key_path then
        key_path, key, no_key = path, nil, nil
        if path ~= "" then key, no_key = read_key(path) end
    end
    if not key then return no_key and "no key: " .. no_key or "no key" end
    if not has_mac then return "none" end
    local all = tvb:raw()
    local mac = all:sub(-16)
    local covered = all:sub(1, 44) .. "\0\0\0\0" .. all:sub(49, -17)
    return sha256(key.outer .. sha256(key.inner .. covered)):sub(1, 16) == mac and "right" or "wrong"
end

-- Sequence ---------------------------------------------------------------------------------------------------------

local streams, epochs, names, findings

function scanhub.init()
    -- By hub, epoch, sensor and topic: the highest number and those seen in the window below it.
    streams = {}
    -- By hub: the latest epoch.
    epochs = {}
    -- By hub and sensor: its name.
    names = {}
    -- By number of the frame, from the first pass: what to flag.
    findings = {}
end

-- What a datagram is beside those before it: the field to show and its value, or nothing.
local function judge(hub, epoch, sensor, topic, sequence)
    if epochs[hub] and epoch < epochs[hub] then
        return { "retired", epochs[hub] }
    end
    epochs[hub] = epoch
    local key = table.concat({ hub, epoch, sensor, topic }, "/")
    local stream = streams[key]
    if not stream then
        streams[key] = { highest = sequence, seen = { [sequence] = true } }
        return nil
    end
    local ahead = (sequence - stream.highest) % 0x100000000
    if ahead > 0 and ahead < 0x80000000 then
        -- What leaves the window is forgotten, at most the whole window.
        for behind = 0, math.min(ahead, WINDOW) - 1 do
            stream.seen[(stream.highest - WINDOW + 1 + behind) % 0x100000000] = nil
        end
        stream.highest = sequence
        stream.seen[sequence] = true
        if ahead > 1 then
            return { "lost", ahead - 1 }
        end
        return nil
    end
    local below = (stream.highest - sequence) % 0x100000000
    if below >= WINDOW then
        return { "stale", below }
    end
    if stream.seen[sequence] then
        return { "duplicate", below }
    end
    stream.seen[sequence] = true
    return { "reordered", below }
end

-- Payloads ---------------------------------------------------------------------------------------------------------
-- Each adds its fields to the tree and answers a few words for the Info column; `nil` if the payload is shorter than its
-- own counts say.

local unpack_payload = {}

-- Adds fields that stand one behind the other: pairs of a name and a length.
local function add_fields(tree, payload, at, ...)
    local list = { ... }
    for i = 1, #list, 2 do
        tree:add_le(f[list[i]], payload(at, list[i + 1]))
        at = at + list[i + 1]
    end
end

unpack_payload[0] = function(payload, tree, hub, sensor)
    local len = payload:len()
    if len < 68 or len < 68 + 8 * payload(64, 1):uint() then return nil end
    local name = payload(8, 32):stringz()
    if not name:match("^[a-z0-9_-]+$") or #name > 24 or name == "robot" then return nil end
    names[hub .. "/" .. sensor] = name
    tree:add_le(f["announce.boot"], payload(0, 8))
    tree:add(f["announce.sensor"], payload(8, 32), name)
    tree:add(f["announce.type"], payload(40, 24), payload(40, 24):stringz())
    for i = 0, payload(64, 1):uint() - 1 do
        local at = 68 + 8 * i
        local topic = payload(at, 1):uint()
        local item = tree:add(payload(at, 8), "Topic " .. (TOPICS[topic] or topic))
        add_fields(item, payload, at, "announce.topic", 1, "announce.group", 1, "announce.port", 2, "announce.next", 4)
    end
    return payload(64, 1):uint() .. " topics"
end

unpack_payload[1] = function(payload, tree, _, _, family)
    local len, words = payload:len(), ""
    -- Of an LMS it says its length; of other families it is all of the payload.
    if family == 0 then
        if len < 4 or payload(0, 1):uint() ~= 2 then return nil end
        len = payload(2, 2):le_uint() + 6
    end
    if len == 0 or len > payload:len() or len > 814 then return nil end
    local item = tree:add(f["telegram"], payload(0, len))
    local packet = PACKET[family]
    if packet then
        item:add(f["telegram.packets"], math.floor(len / packet)):set_generated()
        for at = 0, len - packet, packet do item:add(f["telegram.packet"], payload(at, packet)) end
        words = string.format("%d packets, ", math.floor(len / packet))
    end
    return words .. len .. " bytes"
end

local function is_finite(number)
    return number == number and math.abs(number) < math.huge
end

-- What a value stands for that is no range.
local function code_of(value, family, no_return)
    if value ~= 0xFFFF and family == 0 then return OF_LMS[no_return - value] or "overflow" end
    return CODES[math.min(0xFFFF - value, 7)]
end

unpack_payload[2] = function(payload, tree)
    local len = payload:len()
    if len < 64 then return nil end
    local count, valid_to, no_return = payload(32, 2):le_uint(), payload(34, 2):le_uint(), payload(36, 2):le_uint()
    local family, contents, intensity_bits = payload(42, 1):uint(), payload(44, 1):uint(), payload(45, 1):uint()
    local sizes = {
        angle = contents >= 4 and 4 or 0,
        range = 2,
        wide = contents % 4 >= 2 and 2 or 0,
        upper = contents % 2,
    }
    local of_beam = sizes.angle + sizes.range + sizes.wide + sizes.upper
    if count > 8192 or contents > 7 or len < 64 + of_beam * count then return nil end
    if not (is_finite(payload(0, 8):le_float()) and is_finite(payload(8, 8):le_float())
        and is_finite(payload(16, 4):le_float())) then
        return nil
    end
    add_fields(tree, payload, 0, "scan.first_angle", 8, "scan.step", 8, "scan.spacing", 4, "scan.beam_time_ns", 4,
        "scan.first_beam_ns", 4, "scan.unit_um", 4, "scan.count", 2, "scan.valid_to", 2, "scan.no_return", 2,
        "scan.beyond", 2, "scan.collapsed", 2, "scan.family", 1, "scan.incomplete", 1, "scan.contents", 1,
        "scan.intensity_bits", 1, "scan.turns", 1)
    add_fields(tree, payload, 48, "scan.turn_ns", 4)
    if count == 0 then return "0 beams" end
    local at = 64
    -- Calls `each` with the number and the bytes of each beam in the next array.
    local function array(name, size, each)
        if size == 0 then return end
        local branch = tree:add(payload(at, size * count), name)
        for i = 0, count - 1 do
            each(branch, i, payload(at + size * i, size))
        end
        at = at + size * count
    end
    local function add(branch, name, i, bytes)
        return branch:add_le(f[name], bytes):prepend_text("Beam " .. i .. ": ")
    end
    array("Exact angles", sizes.angle, function(branch, i, bytes)
        local angle = bytes:le_float()
        if angle == angle then add(branch, "scan.angle", i, bytes) end
    end)
    array("Ranges", sizes.range, function(branch, i, bytes)
        local item, value = add(branch, "scan.range", i, bytes), bytes:le_uint()
        if value > valid_to then item:add(f["scan.code"], bytes, code_of(value, family, no_return)) end
    end)
    array("Intensities", sizes.wide, function(branch, i, bytes)
        if intensity_bits > 0 then add(branch, "scan.intensity", i, bytes) end
    end)
    array("Upper bits", sizes.upper, function(branch, i, bytes)
        local item = add(branch, "scan.upper", i, bytes)
        if intensity_bits > 0 and sizes.wide == 0 then item:add_le(f["scan.intensity"], bytes) end
    end)
    return count .. " beams"
end

unpack_payload[3] = function(payload, tree)
    local len = payload:len()
    if len < 4 then return nil end
    local count = payload(0, 1):uint()
    if count > 64 or len < 4 + 16 * count then return nil end
    tree:add(f["marks.count"], payload(0, 1))
    tree:add(f["marks.overflow"], payload(1, 1))
    tree:add(f["marks.unavailable"], payload(1, 1))
    for i = 0, count - 1 do
        local item = tree:add(payload(4 + 16 * i, 16), "Mark " .. i)
        add_fields(item, payload, 4 + 16 * i, "marks.angle_mdeg", 4, "marks.range_dmm", 4, "marks.weight", 2,
            "marks.peak", 1, "marks.edge", 1, "marks.first_beam", 2, "marks.last_beam", 2)
    end
    return count .. " marks"
end

unpack_payload[4] = function(payload, tree)
    local len = payload:len()
    if len < 12 then return nil end
    local count = payload(1, 1):uint()
    if count > 8 or len < 12 + 8 * count then return nil end
    add_fields(tree, payload, 0, "zones.verdict", 1, "zones.count", 1, "zones.nearest_beam", 2, "zones.nearest_mm", 4,
        "zones.invalid_beams", 2, "zones.provisional", 1)
    for i = 0, count - 1 do
        local item = tree:add(payload(12 + 8 * i, 8), "Zone " .. i)
        add_fields(item, payload, 12 + 8 * i, "zones.radius_mm", 2, "zones.beams", 2, "zones.violated", 1)
    end
    return VERDICTS[payload(0, 1):uint()] or "unknown"
end

unpack_payload[5] = function(payload, tree)
    local len = payload:len()
    if len < 24 then return nil end
    local count, beams, segments = payload(8, 2):le_uint(), payload(10, 2):le_uint(), payload(12, 2):le_uint()
    local set = math.floor((count + 7) / 8)
    if count > 8192 or beams > count or segments > 64 or len < 24 + set + 2 * beams + 16 * segments then return nil end
    local function bit(at, i)
        return bits.band(bits.rshift(payload(at + math.floor(i / 8), 1):uint(), i % 8), 1)
    end
    for i = segments, 63 do
        if bit(16, i) == 1 then return nil end
    end
    local members = {}
    for i = 0, 8 * set - 1 do
        if bit(24, i) == 1 then
            if i >= count then return nil end
            table.insert(members, i)
        end
    end
    if #members ~= beams then return nil end
    local begin = 24 + set + 2 * beams
    for at = begin, begin + 16 * segments - 1, 16 do
        local first, last = payload(at, 2):le_uint(), payload(at + 2, 2):le_uint()
        if first > last or last >= count then return nil end
    end
    add_fields(tree, payload, 0, "foreground.generation", 4, "foreground.unit_um", 4, "foreground.count", 2,
        "foreground.beams", 2, "foreground.segments", 2, "foreground.left_out", 2)
    if set > 0 then tree:add(f["foreground.set"], payload(24, set)) end
    for n, beam in ipairs(members) do
        local range = payload(24 + set + 2 * (n - 1), 2)
        local item = tree:add(range, "Beam " .. beam)
        item:add(f["foreground.beam"], payload(24 + math.floor(beam / 8), 1), beam)
        item:add_le(f["foreground.range"], range)
    end
    for i = 0, segments - 1 do
        local item = tree:add(payload(begin + 16 * i, 16), "Segment " .. i)
        add_fields(item, payload, begin + 16 * i, "foreground.first", 2, "foreground.last", 2, "foreground.nearest", 2,
            "foreground.width", 2, "foreground.x_mm", 4, "foreground.y_mm", 4)
        item:add(f["foreground.support"], payload(16 + math.floor(i / 8), 1), bit(16, i))
    end
    return beams .. " of " .. count .. " beams, " .. segments .. " segments"
end

unpack_payload[6] = function(payload, tree)
    local len = payload:len()
    if len < 32 then return nil end
    local count = payload(26, 2):le_uint()
    if count > 8192 or len < 32 + 2 * count then return nil end
    if not (is_finite(payload(0, 8):le_float()) and is_finite(payload(8, 8):le_float())) then return nil end
    add_fields(tree, payload, 0, "background.first_angle", 8, "background.step", 8, "background.generation", 4,
        "background.unit_um", 4, "background.taught", 2, "background.count", 2, "background.frozen", 1)
    for i = 0, count - 1 do
        tree:add_le(f["background.range"], payload(32 + 2 * i, 2)):prepend_text("Beam " .. i .. ": ")
    end
    return payload(24, 2):le_uint() .. " of " .. count .. " beams taught"
end

unpack_payload[7] = function(payload, tree)
    if payload:len() < 592 then return nil end
    add_fields(tree, payload, 0, "status.state", 1, "status.mode", 1, "status.unit_mm", 1,
        "status.family", 1)
    add_fields(tree, payload, 4, "status.baud", 4, "status.since_ns", 8, "status.rate_mhz", 4, "status.angle_deg", 2,
        "status.resolution_cdeg", 2)
    for _, text in ipairs({ { "type", 24, 24 }, { "port", 48, 128 }, { "last_error", 176, 160 } }) do
        local range = payload(text[2], text[3])
        tree:add(f["status." .. text[1]], range, range:stringz(ENC_UTF_8))
    end
    for i, name in ipairs(COUNTERS) do
        tree:add_le(f["status." .. name], payload(328 + 8 * i, 8))
    end
    add_fields(tree, payload, 560, "status.x_m", 8, "status.y_m", 8, "status.yaw_rad", 8, "status.upside_down", 1)
    return STATES[payload(0, 1):uint()] or "unknown"
end

unpack_payload[8] = function(payload, tree)
    local len = payload:len()
    if len < 12 then return nil end
    local count, corners = payload(0, 1):uint(), payload(1, 1):uint()
    local behind = 12 + 40 * count
    if count > 64 or corners > 64 or len < behind + 12 * corners then return nil end
    if not is_finite(payload(8, 4):le_float()) then return nil end
    for i = 0, count - 1 do
        for n = 0, 7 do
            if not is_finite(payload(12 + 40 * i + 4 * n, 4):le_float()) then return nil end
        end
    end
    for at = behind, behind + 12 * corners - 1, 12 do
        if not (is_finite(payload(at, 4):le_float()) and is_finite(payload(at + 4, 4):le_float())) then return nil end
        if payload(at + 8, 2):le_uint() >= count or payload(at + 10, 2):le_uint() >= count then return nil end
    end
    tree:add(f["lines.overflow"], payload(2, 1))
    add_fields(tree, payload, 4, "lines.readings", 2, "lines.on_lines", 2, "lines.noise_m", 4)
    for i = 0, count - 1 do
        local item = tree:add(payload(12 + 40 * i, 40), "Line " .. i)
        add_fields(item, payload, 12 + 40 * i, "lines.x1_m", 4, "lines.y1_m", 4, "lines.x2_m", 4, "lines.y2_m", 4,
            "lines.r_m", 4, "lines.alpha_rad", 4, "lines.sd_r_m", 4, "lines.sd_alpha_rad", 4, "lines.first", 2,
            "lines.last", 2, "lines.points", 2)
    end
    for i = 0, corners - 1 do
        local item = tree:add(payload(behind + 12 * i, 12), "Corner " .. i)
        add_fields(item, payload, behind + 12 * i, "lines.x_m", 4, "lines.y_m", 4, "lines.first_line", 2,
            "lines.second_line", 2)
    end
    return count .. " lines, " .. corners .. " corners"
end

local METHODS = { [0] = "first", "refused", "beams", "points", "lines", "both" }

unpack_payload[9] = function(payload, tree)
    if payload:len() < 80 then return nil end
    for at = 0, 16, 8 do
        if not is_finite(payload(at, 8):le_float()) then return nil end
    end
    for at = 24, 72, 4 do
        if not is_finite(payload(at, 4):le_float()) then return nil end
    end
    -- Revision 1 ends before the covariance of the sum.
    local has_pose_covariance = payload:len() >= 120
    for at = 80, has_pose_covariance and 112 or 0, 4 do
        if not is_finite(payload(at, 4):le_float()) then return nil end
    end
    add_fields(tree, payload, 0, "motion.x_m", 8, "motion.y_m", 8, "motion.yaw_rad", 8, "motion.dx_m", 4,
        "motion.dy_m", 4, "motion.dyaw_rad", 4)
    for at = 36, 68, 4 do
        tree:add_le(f["motion.covariance"], payload(at, 4))
    end
    add_fields(tree, payload, 72, "motion.overlap", 4)
    tree:add(f["motion.method"], payload(76, 1))
    local method, flags = payload(76, 1):uint(), payload(77, 1):uint()
    -- There is a sum, and no step in it was degenerate.
    local is_valid = METHODS[method] and method ~= 1 and flags % 4 < 2
    tree:add(f["motion.valid"], payload(77, 1), is_valid and 1 or 0)
    tree:add(f["motion.degenerate"], payload(77, 1))
    add_fields(tree, payload, 78, "motion.breaks", 2)
    for at = 80, has_pose_covariance and 112 or 0, 4 do
        tree:add_le(f["motion.pose_covariance"], payload(at, 4))
    end
    return METHODS[payload(76, 1):uint()] or "refused"
end

unpack_payload[10] = function(payload, tree)
    if payload:len() < 12 then return nil end
    local verdict = payload(0, 1):uint()
    if verdict < 1 or verdict > 2 then return nil end
    add_fields(tree, payload, 0, "early.verdict", 1, "early.withdrawn", 1, "early.beam", 2, "early.distance_mm", 4,
        "early.bytes_seen", 2, "early.beams_seen", 2)
    return VERDICTS[verdict] .. (payload(1, 1):uint() % 2 == 1 and " withdrawn" or "")
end

unpack_payload[11] = function(payload, tree)
    local len = payload:len()
    if len < 8 then return nil end
    local count, sensors = payload(0, 1):uint(), payload(1, 1):uint()
    local behind = 8 + 80 * count
    if count > 64 or sensors > 32 or len < behind + 72 * sensors then return nil end
    for at = 8, behind - 1, 80 do
        for n = 8, 36, 4 do
            if not is_finite(payload(at + n, 4):le_float()) then return nil end
        end
        if payload(at + 44, 4):le_uint() >= 2 ^ sensors then return nil end
    end
    for at = behind, behind + 72 * sensors - 1, 72 do
        for n = 0, 8, 4 do
            if not is_finite(payload(at + n, 4):le_float()) then return nil end
        end
    end
    for at = 8, behind - 1, 80 do
        local item = tree:add(payload(at, 80), "Person")
        add_fields(item, payload, at, "tracks.id", 8, "tracks.x_m", 4, "tracks.y_m", 4, "tracks.vx_m_s", 4,
            "tracks.vy_m_s", 4)
        for n = 24, 32, 4 do
            item:add_le(f["tracks.covariance"], payload(at + n, 4))
        end
        add_fields(item, payload, at + 36, "tracks.score", 4, "tracks.age_ms", 4, "tracks.sensors", 4)
        item:add(f["tracks.room"], payload(at + 48, 24), payload(at + 48, 24):stringz(ENC_UTF_8))
        item:add(f["tracks.state"], payload(at + 72, 1))
    end
    for at = behind, behind + 72 * sensors - 1, 72 do
        local item = tree:add(payload(at, 72), "Sensor")
        add_fields(item, payload, at, "tracks.site_x_m", 4, "tracks.site_y_m", 4, "tracks.yaw_rad", 4,
            "tracks.upside_down", 1)
        item:add(f["tracks.name"], payload(at + 16, 56), payload(at + 16, 56):stringz(ENC_UTF_8))
    end
    return count .. " people"
end

unpack_payload[12] = function(payload, tree)
    if payload:len() < 112 or payload(8, 1):uint() > 2 then return nil end
    local kind = payload(8, 1):uint()
    add_fields(tree, payload, 0, "events.id", 8, "events.kind", 1)
    for i, name in ipairs({ "room", "door", "from", "to" }) do
        if i == 1 or kind == 2 then
            local range = payload(24 * i - 8, 24)
            tree:add(f["events." .. name], range, range:stringz(ENC_UTF_8))
        end
    end
    return EVENTS[kind]
end

unpack_payload[13] = function(payload, tree)
    if payload:len() < 16 or not is_finite(payload(0, 8):le_float()) then return nil end
    -- A rate that is no number is not known.
    local rate = payload(8, 8):le_float()
    if rate == math.huge or rate == -math.huge then return nil end
    add_fields(tree, payload, 0, "tilt.angle_rad", 8, "tilt.rate_rad_s", 8)
    return string.format("%.2f deg", math.deg(payload(0, 8):le_float()))
end

unpack_payload[14] = function(payload, tree)
    local len = payload:len()
    if len < 16 then return nil end
    local count = payload(8, 2):le_uint()
    if count > 8192 or len < 16 + 16 * count then return nil end
    for i = 1, count do
        for n = 0, 8, 4 do
            if not is_finite(payload(16 * i + n, 4):le_float()) then return nil end
        end
    end
    add_fields(tree, payload, 0, "cloud.sweep", 4, "cloud.generation", 4)
    for _, flag in ipairs({ "first", "last", "complete", "doubted" }) do
        tree:add(f["cloud." .. flag], payload(10, 1))
    end
    for i = 1, count do
        local item = tree:add(payload(16 * i, 16), "Point " .. i - 1)
        add_fields(item, payload, 16 * i, "cloud.x_m", 4, "cloud.y_m", 4, "cloud.z_m", 4, "cloud.beam", 2, "cloud.class", 1)
    end
    return count .. " points"
end

unpack_payload[15] = function(payload, tree)
    local len = payload:len()
    if len < 16 then return nil end
    local count = payload(12, 1):uint()
    if count > 64 or len < 16 + 48 * count then return nil end
    for at = 16, 48 * count, 48 do
        for n = 0, 36, 4 do
            if not is_finite(payload(at + n, 4):le_float()) then return nil end
        end
    end
    add_fields(tree, payload, 0, "obstacles.sweep", 4, "obstacles.generation", 4, "obstacles.left_out", 4)
    tree:add(f["obstacles.complete"], payload(13, 1))
    tree:add(f["obstacles.doubted"], payload(13, 1))
    for at = 16, 48 * count, 48 do
        local item = tree:add(payload(at, 48), "Obstacle")
        add_fields(item, payload, at, "obstacles.x_m", 4, "obstacles.y_m", 4, "obstacles.z_m", 4)
        for n = 12, 20, 4 do
            item:add_le(f["obstacles.low_m"], payload(at + n, 4))
        end
        for n = 24, 32, 4 do
            item:add_le(f["obstacles.high_m"], payload(at + n, 4))
        end
        add_fields(item, payload, at + 36, "obstacles.distance_m", 4, "obstacles.points", 4)
        item:add(f["obstacles.foreground"], payload(at + 44, 1))
        item:add(f["obstacles.near"], payload(at + 44, 1))
    end
    return count .. " obstacles"
end

-- Datagram ---------------------------------------------------------------------------------------------------------

local FLAGS = { "authenticated", "simulated", "replayed", "stamp_estimated", "suspect" }

-- Why bytes are no datagram, in the order of the checks; nothing if they are one.
local function refusal(tvb)
    local len = tvb:len()
    if len < 48 then return "short" end
    if tvb(0, 4):string() ~= "SHUB" then return "magic" end
    if tvb(4, 1):uint() ~= 2 then return "version" end
    local header = tvb(5, 1):uint()
    local part, parts = tvb(33, 1):uint(), tvb(34, 1):uint()
    if header < 48 or header > len or part >= parts then return "header" end
    local mac = tvb(7, 1):uint() % 2 * 16
    if header + tvb(36, 2):le_uint() + mac ~= len then return "length" end
    if parts > 1 and tvb(36, 2):le_uint() > 1424 then return "length" end
    if scanhub.prefs.crc and crc_of(tvb) ~= tvb(44, 4):le_uint() then return "crc" end
    return nil
end

local function add_header(tvb, tree)
    tree:add(f["magic"], tvb(0, 4))
    add_fields(tree, tvb, 4, "version", 1, "header_length", 1, "topic", 1)
    local flags = tree:add(f["flags"], tvb(7, 1))
    for _, name in ipairs(FLAGS) do
        flags:add(f["flags." .. name], tvb(7, 1))
    end
    add_fields(tree, tvb, 8, "hub", 8, "epoch", 4, "sequence", 4, "stamp_ns", 8)
    local stamp_ns = tvb(24, 8):le_uint64()
    local stamp = NSTime.new((stamp_ns / 1000000000):tonumber(), (stamp_ns % 1000000000):tonumber())
    tree:add(f["stamp"], tvb(24, 8), stamp):set_generated()
    add_fields(tree, tvb, 32, "sensor", 1, "part", 1, "parts", 1, "family", 1)
    add_fields(tree, tvb, 36, "payload_length", 2, "revision", 2, "counter", 4)
end

local function add_refusal(tree, pinfo, reason)
    tree:add(f["refused"], reason):set_generated()
    tree:add_proto_expert_info(expert_refused, "refused: " .. reason)
    pinfo.cols.info = "refused: " .. reason
end

function scanhub.dissector(tvb, pinfo, root)
    pinfo.cols.protocol = "SCANHUB"
    local tree = root:add(scanhub, tvb())
    if tvb:len() < tvb:reported_len() then
        pinfo.cols.info = "cut by the capture"
        return
    end
    local reason = refusal(tvb)
    if tvb:len() >= 48 then
        add_header(tvb, tree)
        tree:add_le(f["crc"], tvb(44, 4))
    end
    if reason then
        if reason == "crc" then tree:add(f["crc_status"], "bad"):set_generated() end
        return add_refusal(tree, pinfo, reason)
    end
    tree:add(f["crc_status"], scanhub.prefs.crc and "good" or "unchecked"):set_generated()

    local header, length = tvb(5, 1):uint(), tvb(36, 2):le_uint()
    local has_mac = tvb:len() > header + length
    if has_mac then tree:add(f["mac"], tvb(header + length)) end
    local status = mac_status(tvb, has_mac)
    if has_mac or key then tree:add(f["mac_status"], status):set_generated() end
    if status == "wrong" then return add_refusal(tree, pinfo, "mac") end
    if status == "none" then return add_refusal(tree, pinfo, "unauthenticated") end
    local topic, sensor = tvb(6, 1):uint(), tvb(32, 1):uint()
    local hub, epoch, sequence = tostring(tvb(8, 8):le_uint64()), tvb(16, 4):le_uint(), tvb(20, 4):le_uint()
    if header > 48 then tree:add(f["later"], tvb(48, header - 48)) end

    local unpack = unpack_payload[topic]
    local words
    local part, parts = tvb(33, 1):uint(), tvb(34, 1):uint()
    if unpack and parts > 1 then
        words = string.format("part %d of %d, %d bytes", part + 1, parts, length)
    elseif unpack and length > 0 and tvb(38, 2):le_uint() > 0 then
        local payload = tvb(header, length)
        words = unpack(payload:tvb(), tree:add(payload, "Payload: " .. TOPICS[topic]), hub, sensor, tvb(35, 1):uint())
    end
    if not words then
        return add_refusal(tree, pinfo, unpack and "payload" or "skipped")
    end
    -- A number is that of the whole sample: its first part stands for it.
    if not pinfo.visited and part == 0 then
        findings[pinfo.number] = judge(hub, epoch, sensor, topic, sequence)
    end
    local name = names[hub .. "/" .. sensor]
    if name then tree:add(f["sensor_name"], name):set_generated() end
    local info = string.format("%s/%s #%d, %s", name or sensor, TOPICS[topic], sequence, words)
    local finding = findings[pinfo.number]
    if finding then
        local flag = string.format("%s %d", finding[1], finding[2])
        tree:add(f[finding[1]], finding[2]):set_generated()
        tree:add_proto_expert_info(finding[1] == "lost" and expert_lost or expert_order, flag)
        info = info .. " [" .. flag .. "]"
    end
    pinfo.cols.info = info
end

DissectorTable.get("udp.port"):add(PORT, scanhub)
