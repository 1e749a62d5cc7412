/*
 * The datagrams of `scanhub gateway` for programs in C: checks one, and tells what it says. Refuses to know sockets and
 * what is missing between two datagrams. C99, one header, no heap; docs/datagram.md has the bytes.
 *
 *     struct scanhub_datagram datagram;
 *     struct scanhub_scan scan;
 *     if (scanhub_read(bytes, len, &datagram) == SCANHUB_OK && scanhub_read_scan(&datagram, &scan) == SCANHUB_OK)
 *         for (unsigned i = 0; i < scan.count; i++)
 *             use(scanhub_scan_m(&scan, i), scanhub_scan_angle(&scan, i));
 *
 * What is read points into the datagram and lives as long as its bytes do. They are hostile input: nothing that a function
 * here answers with SCANHUB_OK leads outside of them, as long as an index is below the count that came with it.
 */
#ifndef SCANHUB_H
#define SCANHUB_H

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#ifdef __cplusplus
extern "C" {
#endif

/* The groups are 239.255.76.80 to .83, all on this port: .80 announce and status, .81 zones, early, marks, lines, motion,
 * foreground, tracks, events, tilt and obstacles, .82
 * scan, background and cloud, .83 telegram. */
#define SCANHUB_PORT 22200
/* The longest datagram that a gateway ever sends. */
#define SCANHUB_MAX 1472

enum scanhub_topic {
    SCANHUB_ANNOUNCE = 0,
    SCANHUB_TELEGRAM = 1,
    SCANHUB_SCAN = 2,
    SCANHUB_MARKS = 3,
    SCANHUB_ZONES = 4,
    SCANHUB_FOREGROUND = 5,
    SCANHUB_BACKGROUND = 6,
    SCANHUB_STATUS = 7,
    SCANHUB_LINES = 8,
    SCANHUB_MOTION = 9,
    SCANHUB_EARLY = 10,
    SCANHUB_TRACKS = 11,
    SCANHUB_EVENTS = 12,
    SCANHUB_TILT = 13,
    SCANHUB_CLOUD = 14,
    SCANHUB_OBSTACLES = 15
};

/* Bits of `flags`. */
enum scanhub_flag {
    SCANHUB_AUTHENTICATED = 1,
    SCANHUB_SIMULATED = 2,
    SCANHUB_REPLAYED = 4,
    SCANHUB_STAMP_ESTIMATED = 8,
    SCANHUB_SUSPECT = 16
};

/* Why something is refused, in the order of the checks. */
enum scanhub_result {
    SCANHUB_OK = 0,
    SCANHUB_BAD_SHORT,   /* fewer bytes than a header */
    SCANHUB_BAD_MAGIC,   /* it does not begin with SHUB */
    SCANHUB_BAD_VERSION, /* another version */
    SCANHUB_BAD_HEADER,  /* the header is too short, or longer than the datagram, or the part is none of the parts */
    SCANHUB_BAD_LENGTH,  /* the lengths do not add up to the datagram's, or a part is too long */
    SCANHUB_BAD_CRC,     /* the checksum is wrong */
    SCANHUB_BAD_KEY,     /* without a MAC; this one and the next six only scanhub_key.h says */
    SCANHUB_BAD_MAC,     /* the MAC is not of the key */
    SCANHUB_UNTIMELY,    /* its sensor or topic was not announced just now */
    SCANHUB_EPOCH,       /* of a life of its gateway that is over */
    SCANHUB_STALE,       /* its number is too far behind, or from before the first announcement */
    SCANHUB_CAPACITY,    /* there is no room to remember it */
    SCANHUB_DUPLICATE,   /* it came before */
    SCANHUB_SKIPPED,     /* another topic than the one asked for */
    SCANHUB_BAD_PAYLOAD  /* shorter than its own counts say, in contradiction to itself, without revision, or a part */
};

/* A datagram whose header, lengths and checksum are right. Whether a MAC is, scanhub_key.h tells. */
struct scanhub_datagram {
    uint8_t topic;
    uint8_t flags;
    uint64_t hub;       /* the gateway, a random number */
    uint32_t epoch;     /* its life: a greater one ends the one before */
    uint32_t sequence;  /* the sample's number among those of this sensor and topic, wrapping: a gap is what was lost */
    uint64_t stamp_ns;  /* wall clock of the telegram's first byte, ns since 1970; of announce and status that of sending */
    uint8_t sensor;     /* its position in the hub's configuration */
    uint8_t part;       /* which part of the sample this is, from 0 */
    uint8_t parts;      /* in how many it comes: 1 for most. To read one that comes in more, put `payload` of all parts of
                         * one sequence behind each other, point `payload` of one of them to that, and set `parts` to 1 */
    uint8_t family;     /* of the sensor, see enum scanhub_family */
    uint16_t revision;  /* of the payload: a greater one only appends */
    uint32_t counter;   /* the same in all datagrams that came from one telegram */
    const uint8_t *payload;
    uint32_t payload_len;
    const uint8_t *mac; /* 16 bytes, or NULL */
};

static inline uint16_t scanhub_u16(const uint8_t *at) { return (uint16_t)(at[0] | at[1] << 8); }
static inline uint32_t scanhub_u32(const uint8_t *at) { return scanhub_u16(at) | (uint32_t)scanhub_u16(at + 2) << 16; }
static inline uint64_t scanhub_u64(const uint8_t *at) { return scanhub_u32(at) | (uint64_t)scanhub_u32(at + 4) << 32; }
static inline int32_t scanhub_i32(const uint8_t *at)
{
    uint32_t bits = scanhub_u32(at);
    int32_t value;
    memcpy(&value, &bits, sizeof value);
    return value;
}
static inline float scanhub_f32(const uint8_t *at)
{
    uint32_t bits = scanhub_u32(at);
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}
static inline double scanhub_f64(const uint8_t *at)
{
    uint64_t bits = scanhub_u64(at);
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

/* Goes on with a CRC-32C (polynomial 1EDC6F41h, reflected) over `len` bytes; begins with FFFFFFFFh, the result is the
 * complement. Half a byte at a time: a table of 64 bytes instead of one of 1024. */
static inline uint32_t scanhub_crc(uint32_t crc, const uint8_t *bytes, size_t len)
{
    static const uint32_t nibble[16] = {
        0x00000000u, 0x105EC76Fu, 0x20BD8EDEu, 0x30E349B1u, 0x417B1DBCu, 0x5125DAD3u, 0x61C69362u, 0x7198540Du,
        0x82F63B78u, 0x92A8FC17u, 0xA24BB5A6u, 0xB21572C9u, 0xC38D26C4u, 0xD3D3E1ABu, 0xE330A81Au, 0xF36E6F75u};
    while (len--) {
        crc ^= *bytes++;
        crc = crc >> 4 ^ nibble[crc & 15];
        crc = crc >> 4 ^ nibble[crc & 15];
    }
    return crc;
}

/* Checks `len` bytes, a whole datagram as it was received. */
static inline enum scanhub_result scanhub_read(const void *bytes, size_t len, struct scanhub_datagram *out)
{
    static const uint8_t no_crc[4] = {0, 0, 0, 0};
    const uint8_t *at = (const uint8_t *)bytes;
    size_t header, payload, mac;
    uint32_t crc;
    if (len < 48)
        return SCANHUB_BAD_SHORT;
    if (memcmp(at, "SHUB", 4) != 0)
        return SCANHUB_BAD_MAGIC;
    if (at[4] != 2)
        return SCANHUB_BAD_VERSION;
    header = at[5];
    if (header < 48 || header > len || at[33] >= at[34])
        return SCANHUB_BAD_HEADER;
    payload = scanhub_u16(at + 36);
    mac = at[7] & SCANHUB_AUTHENTICATED ? 16 : 0;
    if (header + payload + mac != len || (at[34] > 1 && payload > 1424))
        return SCANHUB_BAD_LENGTH;
    crc = scanhub_crc(0xFFFFFFFFu, at, 44);
    crc = scanhub_crc(crc, no_crc, 4);
    crc = scanhub_crc(crc, at + 48, len - 48);
    if (~crc != scanhub_u32(at + 44))
        return SCANHUB_BAD_CRC;
    out->topic = at[6];
    out->flags = at[7];
    out->hub = scanhub_u64(at + 8);
    out->epoch = scanhub_u32(at + 16);
    out->sequence = scanhub_u32(at + 20);
    out->stamp_ns = scanhub_u64(at + 24);
    out->sensor = at[32];
    out->part = at[33];
    out->parts = at[34];
    out->family = at[35];
    out->revision = scanhub_u16(at + 38);
    out->counter = scanhub_u32(at + 40);
    out->payload = at + header;
    out->payload_len = (uint32_t)payload;
    out->mac = mac ? at + header + payload : NULL;
    return SCANHUB_OK;
}

/* The topic is the one asked for, and the payload is whole, has a revision and at least `least` bytes. */
static inline enum scanhub_result scanhub_expect(const struct scanhub_datagram *datagram, uint8_t topic, size_t least)
{
    if (datagram->topic != topic)
        return SCANHUB_SKIPPED;
    if (datagram->revision == 0 || datagram->parts != 1)
        return SCANHUB_BAD_PAYLOAD;
    return datagram->payload_len < least ? SCANHUB_BAD_PAYLOAD : SCANHUB_OK;
}

/* Copies text that may fill its field; `out` has a byte more than the field. */
static inline void scanhub_text(char *out, const uint8_t *field, size_t len)
{
    memcpy(out, field, len);
    out[len] = 0;
}

/* Who a sensor is and what goes out of it: once a second. */
struct scanhub_announce {
    uint64_t boot;       /* the hub's life */
    char sensor[33];     /* its name: 1 to 24 of a-z, 0-9, _ and - */
    char type[25];       /* what it calls itself, UTF-8; empty if unknown */
    uint8_t count;       /* topics */
    const uint8_t *topics;
};
struct scanhub_announced {
    uint8_t topic;
    uint8_t group; /* last byte of the group's address */
    uint16_t port;
    uint32_t next; /* number that its next datagram will have */
};
static inline enum scanhub_result scanhub_read_announce(const struct scanhub_datagram *datagram,
                                                        struct scanhub_announce *out)
{
    const uint8_t *at = datagram->payload;
    enum scanhub_result result = scanhub_expect(datagram, SCANHUB_ANNOUNCE, 68);
    size_t i, len;
    if (result != SCANHUB_OK)
        return result;
    if (datagram->payload_len < 68 + 8 * (size_t)at[64])
        return SCANHUB_BAD_PAYLOAD;
    out->boot = scanhub_u64(at);
    scanhub_text(out->sensor, at + 8, 32);
    scanhub_text(out->type, at + 40, 24);
    out->count = at[64];
    out->topics = at + 68;
    len = strlen(out->sensor);
    if (len < 1 || len > 24 || strcmp(out->sensor, "robot") == 0)
        return SCANHUB_BAD_PAYLOAD;
    for (i = 0; i < len; i++) {
        char c = out->sensor[i];
        if (!((c >= 'a' && c <= 'z') || (c >= '0' && c <= '9') || c == '_' || c == '-'))
            return SCANHUB_BAD_PAYLOAD;
    }
    return SCANHUB_OK;
}
/* One of them, i below `count`. */
static inline struct scanhub_announced scanhub_announced(const struct scanhub_announce *announce, unsigned i)
{
    const uint8_t *at = announce->topics + 8 * (size_t)i;
    struct scanhub_announced out;
    out.topic = at[0];
    out.group = at[1];
    out.port = scanhub_u16(at + 2);
    out.next = scanhub_u32(at + 4);
    return out;
}

/* Families of scanners: what speaks one protocol. */
enum scanhub_family { SCANHUB_LMS = 0, SCANHUB_LD = 1, SCANHUB_RPLIDAR = 2 };

/* What a sensor sent, as it came: of an LMS a telegram, STX to CRC; of other families whole packets that arrived together. */
struct scanhub_telegram {
    const uint8_t *bytes;
    uint16_t len;
    uint8_t family;
    uint16_t packets; /* their number; 0 of an LMS, and where it is not known here */
};
static inline enum scanhub_result scanhub_read_telegram(const struct scanhub_datagram *datagram,
                                                        struct scanhub_telegram *out)
{
    const uint8_t *at = datagram->payload;
    enum scanhub_result result = scanhub_expect(datagram, SCANHUB_TELEGRAM, 1);
    size_t len;
    if (result != SCANHUB_OK)
        return result;
    len = datagram->payload_len;
    if (datagram->family == SCANHUB_LMS) {
        if (len < 4 || at[0] != 0x02)
            return SCANHUB_BAD_PAYLOAD;
        len = scanhub_u16(at + 2) + (size_t)6;
    }
    if (len > 814 || len > datagram->payload_len)
        return SCANHUB_BAD_PAYLOAD;
    out->bytes = at;
    out->len = (uint16_t)len;
    out->family = datagram->family;
    out->packets = datagram->family == SCANHUB_LD ? (uint16_t)(len / 47) : 0;
    return SCANHUB_OK;
}

/* A scan: at most 8192 beams in the order of their measuring. Angles are in radians: 0 is the sensor's own ahead,
 * counter-clockwise positive seen from above. */
struct scanhub_scan {
    double first_angle;    /* of beam 0 */
    double step;           /* from one beam to the next; negative for a scanner that turns clockwise */
    float spacing;         /* between two points that the sensor itself measures */
    uint32_t beam_time_ns; /* from one beam to the next */
    int32_t first_beam_ns; /* when beam 0 was measured, after the datagram's stamp: mostly before it */
    uint32_t unit_um;      /* micrometres per device unit */
    uint16_t count;
    uint16_t valid_to;     /* the greatest value that is a range; all above are codes */
    uint16_t no_return, beyond;
    uint16_t collapsed;    /* points that found their beam taken by a nearer one */
    uint8_t family;
    uint8_t incomplete;    /* 1: packets of the turn are missing; what was in them is not measured */
    uint8_t intensity_bits;
    uint8_t turns;         /* beam i was measured in turn i modulo this; 0 is 1 */
    uint32_t turn_ns;      /* time of one of several turns */
    const uint8_t *angles; /* exact ones, count x f32, or NULL */
    const uint8_t *ranges; /* count x u16, see below */
    const uint8_t *wide;   /* intensities of more than 8 bits, count x u16, or NULL */
    const uint8_t *upper;  /* intensities or field bits, count bytes, or NULL */
};
static inline enum scanhub_result scanhub_read_scan(const struct scanhub_datagram *datagram, struct scanhub_scan *out)
{
    const uint8_t *at = datagram->payload;
    enum scanhub_result result = scanhub_expect(datagram, SCANHUB_SCAN, 64);
    size_t n, of_beam;
    if (result != SCANHUB_OK)
        return result;
    n = scanhub_u16(at + 32);
    of_beam = 2 + (at[44] & 4 ? (size_t)4 : 0) + (at[44] & 2 ? 2 : 0) + (at[44] & 1);
    out->first_angle = scanhub_f64(at);
    out->step = scanhub_f64(at + 8);
    out->spacing = scanhub_f32(at + 16);
    if (n > 8192 || at[44] > 7 || datagram->payload_len < 64 + n * of_beam || !isfinite(out->first_angle)
        || !isfinite(out->step) || !isfinite(out->spacing))
        return SCANHUB_BAD_PAYLOAD;
    out->beam_time_ns = scanhub_u32(at + 20);
    out->first_beam_ns = scanhub_i32(at + 24);
    out->unit_um = scanhub_u32(at + 28);
    out->count = (uint16_t)n;
    out->valid_to = scanhub_u16(at + 34);
    out->no_return = scanhub_u16(at + 36);
    out->beyond = scanhub_u16(at + 38);
    out->collapsed = scanhub_u16(at + 40);
    out->family = at[42];
    out->incomplete = at[43] & 1;
    out->intensity_bits = at[45];
    out->turns = at[46];
    out->turn_ns = scanhub_u32(at + 48);
    out->angles = at[44] & 4 ? at + 64 : NULL;
    out->ranges = at + 64 + (at[44] & 4 ? 4 * n : 0);
    out->wide = at[44] & 2 ? out->ranges + 2 * n : NULL;
    out->upper = at[44] & 1 ? out->ranges + (at[44] & 2 ? 4 : 2) * n : NULL;
    return SCANHUB_OK;
}
/* The range of beam i in device units, i below `count`, as here everywhere: what is above `valid_to` is no range. */
static inline uint16_t scanhub_scan_range(const struct scanhub_scan *scan, unsigned i)
{
    return scanhub_u16(scan->ranges + 2 * (size_t)i);
}
/* The range of beam i in metres; NAN if it has no reading, whatever the reason. */
static inline double scanhub_scan_m(const struct scanhub_scan *scan, unsigned i)
{
    uint16_t range = scanhub_scan_range(scan, i);
    return range <= scan->valid_to ? (double)range * scan->unit_um / 1e6 : NAN;
}
/* The angle of beam i in radians, exact where the sensor says so. */
static inline double scanhub_scan_angle(const struct scanhub_scan *scan, unsigned i)
{
    double exact = scan->angles ? (double)scanhub_f32(scan->angles + 4 * (size_t)i) : NAN;
    return isnan(exact) ? scan->first_angle + i * scan->step : exact;
}
/* Why beam i has no reading; NULL if it has one. */
static inline const char *scanhub_scan_code(const struct scanhub_scan *scan, unsigned i)
{
    static const char *const words[8] = {
        "not_measured", "no_return", "beyond", "too_near", "too_bright", "weak", "overflow", "error"};
    /* Those of an LMS, from the greatest value of its measuring mode down. */
    static const uint8_t lms[9] = {1, 4, 6, 6, 5, 7, 6, 6, 2};
    unsigned range = scanhub_scan_range(scan, i), greatest = scan->no_return;
    if (range <= scan->valid_to)
        return NULL;
    if (range != 0xFFFF && scan->family == SCANHUB_LMS)
        return words[range <= greatest && greatest - range < 9 ? lms[greatest - range] : 6];
    return words[0xFFFFu - range < 7 ? 0xFFFFu - range : 7];
}
/* The intensity of beam i, or -1 if there are none. */
static inline int32_t scanhub_scan_intensity(const struct scanhub_scan *scan, unsigned i)
{
    if (scan->intensity_bits == 0)
        return -1;
    return scan->wide ? scanhub_u16(scan->wide + 2 * (size_t)i) : scan->upper ? scan->upper[i] : -1;
}
/* When beam i was measured, in ns after the datagram's stamp. */
static inline int64_t scanhub_scan_beam_ns(const struct scanhub_scan *scan, unsigned i)
{
    int64_t turn = i % (scan->turns ? scan->turns : 1u);
    return scan->first_beam_ns + (int64_t)i * scan->beam_time_ns + turn * scan->turn_ns;
}

/* Reflector marks of a scan: at most 64. */
struct scanhub_marks {
    uint8_t count;
    uint8_t overflow;    /* 1: there were more */
    uint8_t unavailable; /* 1: the sensor's mode has no reflector bits, nothing is known of marks */
    const uint8_t *marks;
};
struct scanhub_mark {
    int32_t angle_mdeg;
    uint32_t range_dmm; /* 1/10 mm */
    uint16_t weight;    /* sum of the intensities */
    uint8_t peak;       /* the greatest of them */
    uint8_t edge;       /* 1: a part of it may lie outside of the scan */
    uint16_t first_beam, last_beam;
};
static inline enum scanhub_result scanhub_read_marks(const struct scanhub_datagram *datagram,
                                                     struct scanhub_marks *out)
{
    const uint8_t *at = datagram->payload;
    enum scanhub_result result = scanhub_expect(datagram, SCANHUB_MARKS, 4);
    if (result != SCANHUB_OK)
        return result;
    if (at[0] > 64 || datagram->payload_len < 4 + 16 * (size_t)at[0])
        return SCANHUB_BAD_PAYLOAD;
    out->count = at[0];
    out->overflow = at[1] & 1;
    out->unavailable = at[1] >> 1 & 1;
    out->marks = at + 4;
    return SCANHUB_OK;
}
/* One of them, i below `count`. */
static inline struct scanhub_mark scanhub_mark(const struct scanhub_marks *marks, unsigned i)
{
    const uint8_t *at = marks->marks + 16 * (size_t)i;
    struct scanhub_mark out;
    out.angle_mdeg = scanhub_i32(at);
    out.range_dmm = scanhub_u32(at + 4);
    out.weight = scanhub_u16(at + 8);
    out.peak = at[10];
    out.edge = at[11];
    out.first_beam = scanhub_u16(at + 12);
    out.last_beam = scanhub_u16(at + 14);
    return out;
}

/* Straight lines of a scan, at most 64, and where they meet, in the robot's frame: x ahead of its centre, y to the left. */
struct scanhub_lines {
    uint8_t count;
    uint8_t corner_count;
    uint8_t overflow;  /* 1: there are more than are allowed */
    uint16_t readings; /* beams that have a range */
    uint16_t on_lines; /* of them those that end on a line */
    float noise_m;     /* standard deviation of the ranges */
    const uint8_t *lines;
    const uint8_t *corners;
};
struct scanhub_line {
    float x1_m, y1_m, x2_m, y2_m; /* where its first and its last beam meet it */
    float r_m, alpha_rad;         /* x cos alpha + y sin alpha = r */
    float sd_r_m, sd_alpha_rad;   /* standard deviations */
    uint16_t first, last;         /* beams */
    uint16_t points;              /* those that have a range */
};
struct scanhub_corner {
    float x_m, y_m;
    uint16_t first_line, second_line; /* below `count` */
};
/* One line, i below `count`. */
static inline struct scanhub_line scanhub_line(const struct scanhub_lines *lines, unsigned i)
{
    const uint8_t *at = lines->lines + 40 * (size_t)i;
    struct scanhub_line out;
    out.x1_m = scanhub_f32(at);
    out.y1_m = scanhub_f32(at + 4);
    out.x2_m = scanhub_f32(at + 8);
    out.y2_m = scanhub_f32(at + 12);
    out.r_m = scanhub_f32(at + 16);
    out.alpha_rad = scanhub_f32(at + 20);
    out.sd_r_m = scanhub_f32(at + 24);
    out.sd_alpha_rad = scanhub_f32(at + 28);
    out.first = scanhub_u16(at + 32);
    out.last = scanhub_u16(at + 34);
    out.points = scanhub_u16(at + 36);
    return out;
}
/* One corner, i below `corner_count`. */
static inline struct scanhub_corner scanhub_corner(const struct scanhub_lines *lines, unsigned i)
{
    const uint8_t *at = lines->corners + 12 * (size_t)i;
    struct scanhub_corner out;
    out.x_m = scanhub_f32(at);
    out.y_m = scanhub_f32(at + 4);
    out.first_line = scanhub_u16(at + 8);
    out.second_line = scanhub_u16(at + 10);
    return out;
}
static inline enum scanhub_result scanhub_read_lines(const struct scanhub_datagram *datagram,
                                                     struct scanhub_lines *out)
{
    const uint8_t *at = datagram->payload;
    enum scanhub_result result = scanhub_expect(datagram, SCANHUB_LINES, 12);
    unsigned i, n;
    if (result != SCANHUB_OK)
        return result;
    if (at[0] > 64 || at[1] > 64 || datagram->payload_len < 12 + 40 * (size_t)at[0] + 12 * (size_t)at[1])
        return SCANHUB_BAD_PAYLOAD;
    out->count = at[0];
    out->corner_count = at[1];
    out->overflow = at[2] & 1;
    out->readings = scanhub_u16(at + 4);
    out->on_lines = scanhub_u16(at + 6);
    out->noise_m = scanhub_f32(at + 8);
    out->lines = at + 12;
    out->corners = out->lines + 40 * (size_t)out->count;
    /* All numbers are finite, and corners are of lines that are there. */
    if (!isfinite(scanhub_f32(at + 8)))
        return SCANHUB_BAD_PAYLOAD;
    for (i = 0; i < out->count; i++)
        for (n = 0; n < 8; n++)
            if (!isfinite(scanhub_f32(out->lines + 40 * (size_t)i + 4 * (size_t)n)))
                return SCANHUB_BAD_PAYLOAD;
    for (i = 0; i < out->corner_count; i++) {
        struct scanhub_corner corner = scanhub_corner(out, i);
        if (!isfinite(scanhub_f32(out->corners + 12 * (size_t)i)) || !isfinite(scanhub_f32(out->corners + 12 * (size_t)i + 4))
            || corner.first_line >= out->count || corner.second_line >= out->count)
            return SCANHUB_BAD_PAYLOAD;
    }
    return SCANHUB_OK;
}

/* How the robot moved since the scan before, in its own frame at that scan. */
enum scanhub_method {
    SCANHUB_MOTION_FIRST = 0,   /* there is no scan before, and no step */
    SCANHUB_MOTION_REFUSED = 1, /* no step explains the scan: neither a step nor a place; greater than BOTH is the same */
    SCANHUB_MOTION_BEAMS = 2,
    SCANHUB_MOTION_POINTS = 3,
    SCANHUB_MOTION_LINES = 4,
    SCANHUB_MOTION_BOTH = 5
};
struct scanhub_motion {
    double x_m, y_m, yaw_rad;    /* the sum of all steps: it drifts */
    float dx_m, dy_m, dyaw_rad;  /* the step */
    float covariance[9];         /* of the step, row by row, in the order x, y, yaw: m2, m rad and rad2 */
    float overlap;               /* share of the readings that lie on the scan before */
    uint8_t method;
    uint8_t valid;               /* 1: the sum is known, and none of its steps was degenerate */
    uint8_t degenerate;          /* 1: the surroundings leave a direction open */
    uint16_t breaks;             /* steps that were refused since the start */
    float pose_covariance[9];    /* of the sum, as `covariance`; 0 if it is not valid or the sender is older */
};
static inline enum scanhub_result scanhub_read_motion(const struct scanhub_datagram *datagram,
                                                      struct scanhub_motion *out)
{
    const uint8_t *at = datagram->payload;
    enum scanhub_result result = scanhub_expect(datagram, SCANHUB_MOTION, 80);
    unsigned i;
    int finite;
    if (result != SCANHUB_OK)
        return result;
    out->x_m = scanhub_f64(at);
    out->y_m = scanhub_f64(at + 8);
    out->yaw_rad = scanhub_f64(at + 16);
    out->dx_m = scanhub_f32(at + 24);
    out->dy_m = scanhub_f32(at + 28);
    out->dyaw_rad = scanhub_f32(at + 32);
    for (i = 0; i < 9; i++)
        out->covariance[i] = scanhub_f32(at + 36 + 4 * (size_t)i);
    out->overlap = scanhub_f32(at + 72);
    out->method = at[76];
    out->valid = out->method <= SCANHUB_MOTION_BOTH && out->method != SCANHUB_MOTION_REFUSED && !(at[77] & 2);
    out->degenerate = at[77] & 1;
    out->breaks = scanhub_u16(at + 78);
    finite = isfinite(out->x_m) && isfinite(out->y_m) && isfinite(out->yaw_rad) && isfinite(out->dx_m)
             && isfinite(out->dy_m) && isfinite(out->dyaw_rad) && isfinite(out->overlap);
    for (i = 0; i < 9; i++) {
        /* Revision 1 has 80 bytes. */
        out->pose_covariance[i] = datagram->payload_len < 120 ? 0.0f : scanhub_f32(at + 80 + 4 * (size_t)i);
        finite = finite && isfinite(out->covariance[i]) && isfinite(out->pose_covariance[i]);
    }
    return finite ? SCANHUB_OK : SCANHUB_BAD_PAYLOAD;
}

/* The angle of a mount at `stamp_ns`. */
struct scanhub_tilt {
    double angle_rad;  /* right-handed around the mount's axis */
    double rate_rad_s; /* how fast it grows; nan: not known */
};
static inline enum scanhub_result scanhub_read_tilt(const struct scanhub_datagram *datagram, struct scanhub_tilt *out)
{
    enum scanhub_result result = scanhub_expect(datagram, SCANHUB_TILT, 16);
    if (result != SCANHUB_OK)
        return result;
    out->angle_rad = scanhub_f64(datagram->payload);
    out->rate_rad_s = scanhub_f64(datagram->payload + 8);
    return isfinite(out->angle_rad) && !isinf(out->rate_rad_s) ? SCANHUB_OK : SCANHUB_BAD_PAYLOAD;
}

/* What a point in three dimensions is beside the background. */
enum scanhub_point_class {
    SCANHUB_POINT_UNKNOWN = 0,    /* not known yet, and so is every number that is not here */
    SCANHUB_POINT_BACKGROUND = 1, /* where something stands always */
    SCANHUB_POINT_FOREGROUND = 2, /* nearer than that */
    SCANHUB_POINT_BEHIND = 3      /* farther away */
};
/* The points of one scan. The samples of a sweep come one behind the other, from `first` to `last`. */
struct scanhub_cloud {
    uint32_t sweep;      /* number of the sweep, from 0 */
    uint32_t generation; /* of the background: one more each time that it was forgotten */
    uint16_t count;      /* points, at most 8192 */
    uint8_t first, last; /* 1: the first sample of its sweep, the last one */
    uint8_t complete;    /* 1: the sweep went from turn to turn, and no angle was missing */
    uint8_t doubted;     /* 1: its angles contradict the background */
    const uint8_t *points;
};
struct scanhub_point {
    float x_m, y_m, z_m; /* ahead, to the left, above the floor */
    uint16_t beam;       /* number of the beam in its scan */
    uint8_t point_class; /* enum scanhub_point_class */
};
/* One point, i below `count`. */
static inline struct scanhub_point scanhub_point(const struct scanhub_cloud *cloud, unsigned i)
{
    const uint8_t *at = cloud->points + 16 * (size_t)i;
    struct scanhub_point out;
    out.x_m = scanhub_f32(at);
    out.y_m = scanhub_f32(at + 4);
    out.z_m = scanhub_f32(at + 8);
    out.beam = scanhub_u16(at + 12);
    out.point_class = at[14];
    return out;
}
static inline enum scanhub_result scanhub_read_cloud(const struct scanhub_datagram *datagram,
                                                     struct scanhub_cloud *out)
{
    const uint8_t *at = datagram->payload;
    enum scanhub_result result = scanhub_expect(datagram, SCANHUB_CLOUD, 16);
    unsigned i;
    if (result != SCANHUB_OK)
        return result;
    out->sweep = scanhub_u32(at);
    out->generation = scanhub_u32(at + 4);
    out->count = scanhub_u16(at + 8);
    out->first = at[10] & 1;
    out->last = at[10] >> 1 & 1;
    out->complete = at[10] >> 2 & 1;
    out->doubted = at[10] >> 3 & 1;
    out->points = at + 16;
    if (out->count > 8192 || datagram->payload_len < 16 + 16 * (size_t)out->count)
        return SCANHUB_BAD_PAYLOAD;
    for (i = 0; i < out->count; i++) {
        struct scanhub_point point = scanhub_point(out, i);
        if (!isfinite(point.x_m) || !isfinite(point.y_m) || !isfinite(point.z_m))
            return SCANHUB_BAD_PAYLOAD;
    }
    return SCANHUB_OK;
}

/* What one sweep of a mount has found, the nearest first. */
struct scanhub_obstacles {
    uint32_t sweep, generation; /* as in a cloud */
    uint32_t left_out;          /* obstacles that did not fit */
    uint8_t count;              /* at most 64 */
    uint8_t complete, doubted;  /* as in a cloud; if doubted, nothing is known of what stands there */
    const uint8_t *obstacles;
};
struct scanhub_obstacle {
    float x_m, y_m, z_m;       /* mean of its points: ahead, to the left, above the floor */
    float low_m[3], high_m[3]; /* least and greatest coordinates of its points */
    float distance_m;          /* of its nearest point from the robot's centre, over ground */
    uint32_t points;
    uint8_t foreground;        /* 1: has points before the background */
    uint8_t near;              /* 1: has points in the space that is to be free */
};
/* One obstacle, i below `count`. */
static inline struct scanhub_obstacle scanhub_obstacle(const struct scanhub_obstacles *obstacles, unsigned i)
{
    const uint8_t *at = obstacles->obstacles + 48 * (size_t)i;
    struct scanhub_obstacle out;
    unsigned n;
    out.x_m = scanhub_f32(at);
    out.y_m = scanhub_f32(at + 4);
    out.z_m = scanhub_f32(at + 8);
    for (n = 0; n < 3; n++) {
        out.low_m[n] = scanhub_f32(at + 12 + 4 * (size_t)n);
        out.high_m[n] = scanhub_f32(at + 24 + 4 * (size_t)n);
    }
    out.distance_m = scanhub_f32(at + 36);
    out.points = scanhub_u32(at + 40);
    out.foreground = at[44] & 1;
    out.near = at[44] >> 1 & 1;
    return out;
}
static inline enum scanhub_result scanhub_read_obstacles(const struct scanhub_datagram *datagram,
                                                         struct scanhub_obstacles *out)
{
    const uint8_t *at = datagram->payload;
    enum scanhub_result result = scanhub_expect(datagram, SCANHUB_OBSTACLES, 16);
    unsigned i, n;
    if (result != SCANHUB_OK)
        return result;
    out->sweep = scanhub_u32(at);
    out->generation = scanhub_u32(at + 4);
    out->left_out = scanhub_u32(at + 8);
    out->count = at[12];
    out->complete = at[13] >> 2 & 1;
    out->doubted = at[13] >> 3 & 1;
    out->obstacles = at + 16;
    if (out->count > 64 || datagram->payload_len < 16 + 48 * (size_t)out->count)
        return SCANHUB_BAD_PAYLOAD;
    for (i = 0; i < out->count; i++)
        for (n = 0; n < 10; n++)
            if (!isfinite(scanhub_f32(out->obstacles + 48 * (size_t)i + 4 * (size_t)n)))
                return SCANHUB_BAD_PAYLOAD;
    return SCANHUB_OK;
}

/* What is near the robot: at most 8 circles around its centre, the largest first. */
enum scanhub_verdict { SCANHUB_CLEAR = 0, SCANHUB_SLOW = 1, SCANHUB_STOP = 2, SCANHUB_UNKNOWN = 3 };
struct scanhub_zones {
    uint8_t verdict;       /* what is greater than SCANHUB_UNKNOWN is unknown, too */
    uint8_t count;
    uint16_t nearest_beam; /* FFFFh: no beam has a valid reading */
    uint32_t nearest_mm;   /* from the robot's centre */
    uint16_t invalid_beams;
    uint8_t provisional;   /* 1: too few scans were seen for a violation */
    const uint8_t *zones;
};
struct scanhub_zone {
    uint16_t radius_mm;
    uint16_t beams;   /* that met something inside, in this scan */
    uint8_t violated;
};
static inline enum scanhub_result scanhub_read_zones(const struct scanhub_datagram *datagram,
                                                     struct scanhub_zones *out)
{
    const uint8_t *at = datagram->payload;
    enum scanhub_result result = scanhub_expect(datagram, SCANHUB_ZONES, 12);
    if (result != SCANHUB_OK)
        return result;
    if (at[1] > 8 || datagram->payload_len < 12 + 8 * (size_t)at[1])
        return SCANHUB_BAD_PAYLOAD;
    out->verdict = at[0];
    out->count = at[1];
    out->nearest_beam = scanhub_u16(at + 2);
    out->nearest_mm = scanhub_u32(at + 4);
    out->invalid_beams = scanhub_u16(at + 8);
    out->provisional = at[10] & 1;
    out->zones = at + 12;
    return SCANHUB_OK;
}

/* People at one instant, which is `stamp_ns`, in the map of a site. */
enum scanhub_track_state {
    SCANHUB_TENTATIVE = 0,    /* perhaps a person, and so is every number that is not here */
    SCANHUB_CONFIRMED = 1,    /* a person who is seen */
    SCANHUB_HIDDEN = 2,       /* a person who is not seen, where nobody could be seen either */
    SCANHUB_BETWEEN_ROOMS = 3 /* a person on a way that no sensor sees */
};
struct scanhub_tracks {
    uint8_t count;        /* people, at most 64 */
    uint8_t sensor_count; /* of the site, at most 32 */
    const uint8_t *tracks;
    const uint8_t *sensors;
};
struct scanhub_track {
    uint64_t id;         /* nobody else ever gets it */
    float x_m, y_m;      /* the middle between his legs */
    float vx_m_s, vy_m_s;
    float covariance[3]; /* of the place, m2: xx, xy, yy */
    float score;         /* how sure it is that this is a person, 0 to 1 */
    uint32_t age_ms;     /* since he was first seen */
    uint32_t sensors;    /* bit i: sensor i sees him */
    char room[25];       /* UTF-8; empty: none */
    uint8_t state;
};
/* One person, i below `count`. */
static inline struct scanhub_track scanhub_track(const struct scanhub_tracks *tracks, unsigned i)
{
    const uint8_t *at = tracks->tracks + 80 * (size_t)i;
    struct scanhub_track out;
    unsigned n;
    out.id = scanhub_u64(at);
    out.x_m = scanhub_f32(at + 8);
    out.y_m = scanhub_f32(at + 12);
    out.vx_m_s = scanhub_f32(at + 16);
    out.vy_m_s = scanhub_f32(at + 20);
    for (n = 0; n < 3; n++)
        out.covariance[n] = scanhub_f32(at + 24 + 4 * (size_t)n);
    out.score = scanhub_f32(at + 36);
    out.age_ms = scanhub_u32(at + 40);
    out.sensors = scanhub_u32(at + 44);
    scanhub_text(out.room, at + 48, 24);
    out.state = at[72];
    return out;
}
/* One sensor, i below `sensor_count`. */
struct scanhub_track_sensor {
    float x_m, y_m, yaw_rad; /* where it sits in the map, and looks, counter-clockwise from x */
    uint8_t upside_down;     /* 1: it hangs so */
    char name[57];
};
static inline struct scanhub_track_sensor scanhub_track_sensor(const struct scanhub_tracks *tracks, unsigned i)
{
    const uint8_t *at = tracks->sensors + 72 * (size_t)i;
    struct scanhub_track_sensor out;
    out.x_m = scanhub_f32(at);
    out.y_m = scanhub_f32(at + 4);
    out.yaw_rad = scanhub_f32(at + 8);
    out.upside_down = at[12] == 1;
    scanhub_text(out.name, at + 16, 56);
    return out;
}
static inline enum scanhub_result scanhub_read_tracks(const struct scanhub_datagram *datagram,
                                                      struct scanhub_tracks *out)
{
    const uint8_t *at = datagram->payload;
    enum scanhub_result result = scanhub_expect(datagram, SCANHUB_TRACKS, 8);
    unsigned i, n;
    if (result != SCANHUB_OK)
        return result;
    if (at[0] > 64 || at[1] > 32 || datagram->payload_len < 8 + 80 * (size_t)at[0] + 72 * (size_t)at[1])
        return SCANHUB_BAD_PAYLOAD;
    out->count = at[0];
    out->sensor_count = at[1];
    out->tracks = at + 8;
    out->sensors = out->tracks + 80 * (size_t)out->count;
    /* All numbers are finite, and sensors are some that are there. */
    for (i = 0; i < out->count; i++) {
        const uint8_t *track = out->tracks + 80 * (size_t)i;
        for (n = 8; n < 40; n += 4)
            if (!isfinite(scanhub_f32(track + n)))
                return SCANHUB_BAD_PAYLOAD;
        if ((uint64_t)scanhub_u32(track + 44) >> out->sensor_count)
            return SCANHUB_BAD_PAYLOAD;
    }
    for (i = 0; i < out->sensor_count; i++)
        for (n = 0; n < 12; n += 4)
            if (!isfinite(scanhub_f32(out->sensors + 72 * (size_t)i + n)))
                return SCANHUB_BAD_PAYLOAD;
    return SCANHUB_OK;
}

/* What happened to a person at `stamp_ns`. */
enum scanhub_event_kind { SCANHUB_APPEARED = 0, SCANHUB_LEFT = 1, SCANHUB_DOOR = 2 };
struct scanhub_events {
    uint64_t id;
    uint8_t kind;
    char room[25];                   /* where he then is, UTF-8; empty: none */
    char door[25], from[25], to[25]; /* of SCANHUB_DOOR; else empty */
};
static inline enum scanhub_result scanhub_read_events(const struct scanhub_datagram *datagram,
                                                      struct scanhub_events *out)
{
    const uint8_t *at = datagram->payload;
    enum scanhub_result result = scanhub_expect(datagram, SCANHUB_EVENTS, 112);
    if (result != SCANHUB_OK)
        return result;
    if (at[8] > SCANHUB_DOOR)
        return SCANHUB_BAD_PAYLOAD;
    out->id = scanhub_u64(at);
    out->kind = at[8];
    scanhub_text(out->room, at + 16, 24);
    scanhub_text(out->door, at + 40, out->kind == SCANHUB_DOOR ? 24 : 0);
    scanhub_text(out->from, at + 64, out->kind == SCANHUB_DOOR ? 24 : 0);
    scanhub_text(out->to, at + 88, out->kind == SCANHUB_DOOR ? 24 : 0);
    return SCANHUB_OK;
}

/* A warning by a scan that was not complete, a telegram or a turn: slow or stop, never clear. The first zones with its number or
 * a greater one confirm it, or it is withdrawn. */
struct scanhub_early {
    uint8_t verdict;       /* SCANHUB_SLOW or SCANHUB_STOP */
    uint8_t withdrawn;     /* 1: what was said under this number does not hold */
    uint16_t beam;         /* of the nearest point so far */
    uint32_t distance_mm;  /* of that, from the robot's centre */
    uint16_t bytes_seen;   /* of the telegram; 0 of a turn */
    uint16_t beams_seen;   /* of the scan */
};
static inline enum scanhub_result scanhub_read_early(const struct scanhub_datagram *datagram,
                                                     struct scanhub_early *out)
{
    const uint8_t *at = datagram->payload;
    enum scanhub_result result = scanhub_expect(datagram, SCANHUB_EARLY, 12);
    if (result != SCANHUB_OK)
        return result;
    if (at[0] != SCANHUB_SLOW && at[0] != SCANHUB_STOP)
        return SCANHUB_BAD_PAYLOAD;
    out->verdict = at[0];
    out->withdrawn = at[1] & 1;
    out->beam = scanhub_u16(at + 2);
    out->distance_mm = scanhub_u32(at + 4);
    out->bytes_seen = scanhub_u16(at + 8);
    out->beams_seen = scanhub_u16(at + 10);
    return SCANHUB_OK;
}
/* One of them, i below `count`. */
static inline struct scanhub_zone scanhub_zone(const struct scanhub_zones *zones, unsigned i)
{
    const uint8_t *at = zones->zones + 8 * (size_t)i;
    struct scanhub_zone out;
    out.radius_mm = scanhub_u16(at);
    out.beams = scanhub_u16(at + 2);
    out.violated = at[4];
    return out;
}

/* What stands before the background, in one scan. */
struct scanhub_foreground {
    uint32_t generation;     /* of the background model */
    uint32_t unit_um;        /* micrometres per device unit */
    uint16_t count;          /* beams of the scan, at most 8192 */
    uint16_t beams;          /* beams in the foreground */
    uint16_t segment_count;
    uint16_t left_out;       /* segments for which there was no room */
    uint64_t supported;      /* bit i: `support` of segment i */
    const uint8_t *bits;     /* beam i is bit i % 8 of byte i / 8 */
    const uint8_t *ranges;   /* of the foreground beams, in their order, beams x u16 */
    const uint8_t *segments;
};
struct scanhub_segment {
    uint16_t first, last;    /* beams */
    uint16_t nearest, width; /* device units */
    int32_t x_mm, y_mm;      /* its middle, ahead and to the left of the robot's centre */
    uint8_t support;         /* 1: several beams, or the foreground of the scan before was near; 0: may be an edge that flickers */
};
/* Beam i of the scan is in the foreground, i below `count`. */
static inline int scanhub_is_foreground(const struct scanhub_foreground *foreground, unsigned i)
{
    return foreground->bits[i / 8] >> (i % 8) & 1;
}
/* The range of foreground beam n in device units, n below `beams`. */
static inline uint16_t scanhub_foreground_range(const struct scanhub_foreground *foreground, unsigned n)
{
    return scanhub_u16(foreground->ranges + 2 * (size_t)n);
}
/* One segment, i below `segment_count`. */
static inline struct scanhub_segment scanhub_segment(const struct scanhub_foreground *foreground, unsigned i)
{
    const uint8_t *at = foreground->segments + 16 * (size_t)i;
    struct scanhub_segment out;
    out.first = scanhub_u16(at);
    out.last = scanhub_u16(at + 2);
    out.nearest = scanhub_u16(at + 4);
    out.width = scanhub_u16(at + 6);
    out.x_mm = scanhub_i32(at + 8);
    out.y_mm = scanhub_i32(at + 12);
    out.support = (uint8_t)(foreground->supported >> i & 1);
    return out;
}
static inline enum scanhub_result scanhub_read_foreground(const struct scanhub_datagram *datagram,
                                                          struct scanhub_foreground *out)
{
    const uint8_t *at = datagram->payload;
    enum scanhub_result result = scanhub_expect(datagram, SCANHUB_FOREGROUND, 24);
    size_t count, beams, segments, set;
    unsigned i, members = 0;
    if (result != SCANHUB_OK)
        return result;
    count = scanhub_u16(at + 8);
    beams = scanhub_u16(at + 10);
    segments = scanhub_u16(at + 12);
    set = (count + 7) / 8;
    if (count > 8192 || beams > count || segments > 64 || datagram->payload_len < 24 + set + 2 * beams + 16 * segments)
        return SCANHUB_BAD_PAYLOAD;
    out->generation = scanhub_u32(at);
    out->count = (uint16_t)count;
    out->beams = (uint16_t)beams;
    out->unit_um = scanhub_u32(at + 4);
    out->left_out = scanhub_u16(at + 14);
    out->supported = scanhub_u64(at + 16);
    out->segment_count = (uint16_t)segments;
    out->bits = at + 24;
    out->ranges = at + 24 + set;
    out->segments = at + 24 + set + 2 * beams;
    if (segments < 64 && out->supported >> segments != 0)
        return SCANHUB_BAD_PAYLOAD;
    /* As many beams as ranges, and none beyond the scan. */
    for (i = 0; i < 8 * set; i++) {
        if (scanhub_is_foreground(out, i)) {
            members++;
            if (i >= count)
                return SCANHUB_BAD_PAYLOAD;
        }
    }
    for (i = 0; i < segments; i++) {
        struct scanhub_segment segment = scanhub_segment(out, i);
        if (segment.first > segment.last || segment.last >= count)
            return SCANHUB_BAD_PAYLOAD;
    }
    return members == beams ? SCANHUB_OK : SCANHUB_BAD_PAYLOAD;
}

/* The background model: where each beam ends when nobody is there. */
struct scanhub_background {
    double first_angle;    /* as of a scan */
    double step;           /* 0 before the first scan */
    uint32_t generation;
    uint32_t unit_um;      /* micrometres per device unit */
    uint16_t taught;       /* beams whose background is known */
    uint16_t count;        /* at most 8192 */
    uint8_t frozen;        /* 1: nothing is learned */
    const uint8_t *ranges; /* count x u16 */
};
static inline enum scanhub_result scanhub_read_background(const struct scanhub_datagram *datagram,
                                                          struct scanhub_background *out)
{
    const uint8_t *at = datagram->payload;
    enum scanhub_result result = scanhub_expect(datagram, SCANHUB_BACKGROUND, 32);
    if (result != SCANHUB_OK)
        return result;
    out->first_angle = scanhub_f64(at);
    out->step = scanhub_f64(at + 8);
    out->generation = scanhub_u32(at + 16);
    out->unit_um = scanhub_u32(at + 20);
    out->taught = scanhub_u16(at + 24);
    out->count = scanhub_u16(at + 26);
    out->frozen = at[28] & 1;
    out->ranges = at + 32;
    if (out->count > 8192 || datagram->payload_len < 32 + 2 * (size_t)out->count)
        return SCANHUB_BAD_PAYLOAD;
    return isfinite(out->first_angle) && isfinite(out->step) ? SCANHUB_OK : SCANHUB_BAD_PAYLOAD;
}
/* The range of beam i in device units, i below `count`: 0 not learned, FFFFh beyond what the sensor measures. */
static inline uint16_t scanhub_background_range(const struct scanhub_background *background, unsigned i)
{
    return scanhub_u16(background->ranges + 2 * (size_t)i);
}

/* How a link and its sensor are: each second and on every change. */
struct scanhub_status {
    uint8_t state;            /* 0 absent, 1 probing, 2 switching, 3 starting, 4 streaming, 5 silent, 6 paused */
    uint8_t mode;             /* measuring mode; FFh unknown */
    uint8_t unit_mm;          /* 0 unknown */
    uint8_t family;           /* enum scanhub_family */
    uint32_t baud;            /* 0 unknown */
    uint64_t since_ns;        /* CLOCK_MONOTONIC of the hub's machine when the state began */
    uint32_t rate_mhz;        /* scans per second in 1/1000 */
    uint16_t angle_deg;       /* 0 unknown */
    uint16_t resolution_cdeg; /* 1/100 degree; 0 unknown */
    char type[25], port[129], last_error[161]; /* UTF-8 */
    uint64_t counters[28];    /* in the order of docs/topics.md */
    double x_m, y_m;          /* where the sensor sits: ahead and to the left of the robot's centre */
    double yaw_rad;           /* where it looks, counter-clockwise from ahead */
    uint8_t upside_down;
};
static inline enum scanhub_result scanhub_read_status(const struct scanhub_datagram *datagram,
                                                      struct scanhub_status *out)
{
    const uint8_t *at = datagram->payload;
    enum scanhub_result result = scanhub_expect(datagram, SCANHUB_STATUS, 592);
    unsigned i;
    if (result != SCANHUB_OK)
        return result;
    out->state = at[0];
    out->mode = at[1];
    out->unit_mm = at[2];
    out->family = at[3];
    out->baud = scanhub_u32(at + 4);
    out->since_ns = scanhub_u64(at + 8);
    out->rate_mhz = scanhub_u32(at + 16);
    out->angle_deg = scanhub_u16(at + 20);
    out->resolution_cdeg = scanhub_u16(at + 22);
    scanhub_text(out->type, at + 24, 24);
    scanhub_text(out->port, at + 48, 128);
    scanhub_text(out->last_error, at + 176, 160);
    for (i = 0; i < 28; i++)
        out->counters[i] = scanhub_u64(at + 336 + 8 * (size_t)i);
    out->x_m = scanhub_f64(at + 560);
    out->y_m = scanhub_f64(at + 568);
    out->yaw_rad = scanhub_f64(at + 576);
    out->upside_down = at[584];
    return SCANHUB_OK;
}

#ifdef __cplusplus
}
#endif
#endif
