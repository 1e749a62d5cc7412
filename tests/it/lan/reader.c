/* Reads datagrams with clients/c/scanhub.h. Each line of stdin has the hexadecimal digits of a datagram. For each one, prints
 * a line of JSON in the format of the list of golden datagrams.
 *
 * A line may start with the digits of a key, `@`, the second at which the datagram arrives, and a colon. The printed line is
 * then the outcome of clients/c/scanhub_key.h, which depends on earlier datagrams. */
#include "scanhub_key.h"

#include <stdio.h>
#include <stdlib.h>

static const char *const refusals[] = {"", "short", "magic", "version", "header", "length", "crc",
                                       "unauthenticated", "mac", "untimely", "epoch", "stale", "capacity", "duplicate",
                                       "skipped", "payload"};

static const char *boolean(int value) { return value ? "true" : "false"; }

static void announce(const struct scanhub_announce *a)
{
    printf("{\"boot\":\"%016llx\",\"sensor\":\"%s\",\"type\":\"%s\",\"topics\":[", (unsigned long long)a->boot, a->sensor,
           a->type);
    for (unsigned i = 0; i < a->count; i++) {
        struct scanhub_announced t = scanhub_announced(a, i);
        printf("%s{\"topic\":%u,\"group\":%u,\"port\":%u,\"next\":%lu}", i ? "," : "", t.topic, t.group, t.port,
               (unsigned long)t.next);
    }
    printf("]}");
}

static void telegram(const struct scanhub_telegram *t)
{
    printf("{\"telegram\":\"");
    for (unsigned i = 0; i < t->len; i++)
        printf("%02x", t->bytes[i]);
    printf("\",\"packets\":");
    if (t->family == SCANHUB_LD)
        printf("%u}", t->packets);
    else
        printf("null}");
}

/* Prints a number with a decimal point and the fewest digits that identify it. JSON has neither nan nor infinity. */
static void number(const char *before, double value)
{
    char digits[32];
    int precision = 0;
    do
        snprintf(digits, sizeof digits, "%.*g", ++precision, value);
    while (precision < 17 && strtod(digits, NULL) != value);
    printf("%s%s%s", before, isfinite(value) ? digits : "null",
           digits[strspn(digits, "-0123456789")] == 0 ? ".0" : "");
}

static const char *const families[] = {"lms", "ld", "rplidar"};

static void scan(const struct scanhub_scan *s)
{
    printf("{\"family\":%s%s%s", s->family < 3 ? "\"" : "", s->family < 3 ? families[s->family] : "null",
           s->family < 3 ? "\"" : "");
    printf(",\"unit_um\":%lu,\"count\":%u", (unsigned long)s->unit_um, s->count);
    number(",\"first_angle\":", s->first_angle);
    number(",\"step\":", s->step);
    number(",\"spacing\":", s->spacing);
    printf(",\"beam_time_ns\":%lu,\"valid_to\":%u,\"no_return\":%u,\"beyond\":%u,\"collisions\":%u,\"incomplete\":%s",
           (unsigned long)s->beam_time_ns, s->valid_to, s->no_return, s->beyond, s->collisions, boolean(s->incomplete));
    printf(",\"intensity_bits\":%u,\"ranges\":[", s->intensity_bits);
    for (unsigned i = 0; i < s->count; i++)
        printf("%s%u", i ? "," : "", scanhub_scan_range(s, i));
    printf("],\"m\":[");
    for (unsigned i = 0; i < s->count; i++)
        number(i ? "," : "", scanhub_scan_m(s, i));
    printf("],\"codes\":[");
    for (unsigned i = 0; i < s->count; i++) {
        const char *code = scanhub_scan_code(s, i);
        printf("%s%s%s%s", i ? "," : "", code ? "\"" : "", code ? code : "null", code ? "\"" : "");
    }
    printf("],\"times_ns\":[");
    for (unsigned i = 0; i < s->count; i++)
        printf("%s%lld", i ? "," : "", (long long)scanhub_scan_beam_ns(s, i));
    printf("],\"angles\":[");
    for (unsigned i = 0; s->angles && i < s->count; i++) {
        double exact = scanhub_f32(s->angles + 4 * (size_t)i), angle = scanhub_scan_angle(s, i);
        if (isnan(exact) ? angle != s->first_angle + i * s->step : angle != exact)
            abort();
        number(i ? "," : "", exact);
    }
    printf("],\"intensities\":[");
    for (unsigned i = 0; i < s->count && scanhub_scan_intensity(s, i) >= 0; i++)
        printf("%s%ld", i ? "," : "", (long)scanhub_scan_intensity(s, i));
    printf("],\"upper\":[");
    for (unsigned i = 0; s->upper && i < s->count; i++)
        printf("%s%u", i ? "," : "", s->upper[i]);
    printf("]}");
}

static void marks(const struct scanhub_marks *m)
{
    printf("{\"overflow\":%s,\"unavailable\":%s,\"marks\":[", boolean(m->overflow), boolean(m->unavailable));
    for (unsigned i = 0; i < m->count; i++) {
        struct scanhub_mark k = scanhub_mark(m, i);
        printf("%s{\"angle_mdeg\":%ld,\"range_dmm\":%lu,\"weight\":%u,\"peak\":%u,\"edge\":%u,\"first_beam\":%u,"
               "\"last_beam\":%u}",
               i ? "," : "", (long)k.angle_mdeg, (unsigned long)k.range_dmm, k.weight, k.peak, k.edge, k.first_beam,
               k.last_beam);
    }
    printf("]}");
}

static void early(const struct scanhub_early *e)
{
    printf("{\"verdict\":\"%s\",\"withdrawn\":%s,\"beam\":%u,\"distance_mm\":%lu,\"bytes_seen\":%u,\"beams_seen\":%u}",
           e->verdict == SCANHUB_STOP ? "stop" : "slow", boolean(e->withdrawn), e->beam,
           (unsigned long)e->distance_mm, e->bytes_seen, e->beams_seen);
}

static void tracks(const struct scanhub_tracks *t)
{
    static const char *const states[] = {"tentative", "confirmed", "hidden", "between_rooms"};
    printf("{\"sites\":[");
    for (unsigned i = 0; i < t->sensor_count; i++) {
        struct scanhub_track_sensor s = scanhub_track_sensor(t, i);
        printf("%s{\"name\":\"%s\"", i ? "," : "", s.name);
        number(",\"site_x_m\":", s.x_m);
        number(",\"site_y_m\":", s.y_m);
        number(",\"yaw_rad\":", s.yaw_rad);
        printf(",\"upside_down\":%s}", boolean(s.upside_down));
    }
    printf("],\"tracks\":[");
    for (unsigned i = 0; i < t->count; i++) {
        struct scanhub_track k = scanhub_track(t, i);
        printf("%s{\"id\":%llu", i ? "," : "", (unsigned long long)k.id);
        number(",\"x_m\":", k.x_m);
        number(",\"y_m\":", k.y_m);
        number(",\"vx_m_s\":", k.vx_m_s);
        number(",\"vy_m_s\":", k.vy_m_s);
        for (unsigned n = 0; n < 3; n++)
            number(n ? "," : ",\"covariance\":[", k.covariance[n]);
        number("],\"score\":", k.score);
        printf(",\"age_ms\":%lu,\"sensors\":%lu,\"room\":\"%s\",\"state\":\"%s\"}", (unsigned long)k.age_ms,
               (unsigned long)k.sensors, k.room, states[k.state < 4 ? k.state : 0]);
    }
    printf("]}");
}

static void events(const struct scanhub_events *e)
{
    static const char *const kinds[] = {"appeared", "left", "door"};
    printf("{\"kind\":\"%s\",\"id\":%llu,\"room\":\"%s\",\"door\":\"%s\",\"from\":\"%s\",\"to\":\"%s\"}", kinds[e->kind],
           (unsigned long long)e->id, e->room, e->door, e->from, e->to);
}

static void tilt(const struct scanhub_tilt *t)
{
    number("{\"angle_rad\":", t->angle_rad);
    number(",\"rate_rad_s\":", t->rate_rad_s);
    printf("}");
}

static void cloud(const struct scanhub_cloud *c)
{
    static const char *const classes[] = {"unknown", "background", "foreground", "behind"};
    printf("{\"sweep\":%lu,\"generation\":%lu,\"first\":%s", (unsigned long)c->sweep, (unsigned long)c->generation,
           boolean(c->first));
    printf(",\"last\":%s,\"complete\":%s,\"unreliable\":%s,\"points\":[", boolean(c->last), boolean(c->complete),
           boolean(c->unreliable));
    for (unsigned i = 0; i < c->count; i++) {
        struct scanhub_point p = scanhub_point(c, i);
        number(i ? ",{\"x_m\":" : "{\"x_m\":", p.x_m);
        number(",\"y_m\":", p.y_m);
        number(",\"z_m\":", p.z_m);
        printf(",\"beam\":%u,\"class\":\"%s\"}", p.beam, classes[p.point_class < 4 ? p.point_class : 0]);
    }
    printf("]}");
}

static void obstacles(const struct scanhub_obstacles *s)
{
    printf("{\"sweep\":%lu,\"generation\":%lu,\"complete\":%s", (unsigned long)s->sweep, (unsigned long)s->generation,
           boolean(s->complete));
    printf(",\"unreliable\":%s,\"dropped\":%lu,\"obstacles\":[", boolean(s->unreliable), (unsigned long)s->dropped);
    for (unsigned i = 0; i < s->count; i++) {
        struct scanhub_obstacle o = scanhub_obstacle(s, i);
        number(i ? ",{\"x_m\":" : "{\"x_m\":", o.x_m);
        number(",\"y_m\":", o.y_m);
        number(",\"z_m\":", o.z_m);
        for (unsigned n = 0; n < 3; n++)
            number(n ? "," : ",\"low_m\":[", o.low_m[n]);
        for (unsigned n = 0; n < 3; n++)
            number(n ? "," : "],\"high_m\":[", o.high_m[n]);
        number("],\"distance_m\":", o.distance_m);
        printf(",\"points\":%lu,\"foreground\":%s,\"near\":%s}", (unsigned long)o.points, boolean(o.foreground),
               boolean(o.near));
    }
    printf("]}");
}

static void lines(const struct scanhub_lines *l)
{
    printf("{\"overflow\":%s,\"readings\":%u,\"on_lines\":%u", boolean(l->overflow), l->readings, l->on_lines);
    number(",\"noise_m\":", l->noise_m);
    printf(",\"lines\":[");
    for (unsigned i = 0; i < l->count; i++) {
        struct scanhub_line k = scanhub_line(l, i);
        number(i ? ",{\"x1_m\":" : "{\"x1_m\":", k.x1_m);
        number(",\"y1_m\":", k.y1_m);
        number(",\"x2_m\":", k.x2_m);
        number(",\"y2_m\":", k.y2_m);
        number(",\"r_m\":", k.r_m);
        number(",\"alpha_rad\":", k.alpha_rad);
        number(",\"sd_r_m\":", k.sd_r_m);
        number(",\"sd_alpha_rad\":", k.sd_alpha_rad);
        printf(",\"first\":%u,\"last\":%u,\"points\":%u}", k.first, k.last, k.points);
    }
    printf("],\"corners\":[");
    for (unsigned i = 0; i < l->corner_count; i++) {
        struct scanhub_corner k = scanhub_corner(l, i);
        number(i ? ",{\"x_m\":" : "{\"x_m\":", k.x_m);
        number(",\"y_m\":", k.y_m);
        printf(",\"first_line\":%u,\"second_line\":%u}", k.first_line, k.second_line);
    }
    printf("]}");
}

static void motion(const struct scanhub_motion *m)
{
    static const char *const methods[] = {"first", "refused", "beams", "points", "lines", "both"};
    number("{\"x_m\":", m->x_m);
    number(",\"y_m\":", m->y_m);
    number(",\"yaw_rad\":", m->yaw_rad);
    number(",\"dx_m\":", m->dx_m);
    number(",\"dy_m\":", m->dy_m);
    number(",\"dyaw_rad\":", m->dyaw_rad);
    for (unsigned i = 0; i < 9; i++)
        number(i ? "," : ",\"covariance\":[", m->covariance[i]);
    number("],\"overlap\":", m->overlap);
    printf(",\"method\":\"%s\",\"valid\":%s,\"degenerate\":%s,\"refused_steps\":%u", methods[m->method < 6 ? m->method : 1],
           boolean(m->valid), boolean(m->degenerate), m->refused_steps);
    for (unsigned i = 0; i < 9; i++)
        number(i ? "," : ",\"pose_covariance\":[", m->pose_covariance[i]);
    printf("]}");
}

static void zones(const struct scanhub_zones *z)
{
    static const char *const verdicts[] = {"clear", "slow", "stop", "unknown"};
    printf("{\"verdict\":\"%s\"", verdicts[z->verdict < SCANHUB_UNKNOWN ? z->verdict : SCANHUB_UNKNOWN]);
    if (z->nearest_beam == 0xFFFF)
        printf(",\"nearest_beam\":null,\"nearest_mm\":null");
    else
        printf(",\"nearest_beam\":%u,\"nearest_mm\":%lu", z->nearest_beam, (unsigned long)z->nearest_mm);
    printf(",\"invalid_beams\":%u,\"provisional\":%s,\"zones\":[", z->invalid_beams, boolean(z->provisional));
    for (unsigned i = 0; i < z->count; i++) {
        struct scanhub_zone one = scanhub_zone(z, i);
        printf("%s{\"radius_mm\":%u,\"beams\":%u,\"violated\":%s}", i ? "," : "", one.radius_mm, one.beams,
               boolean(one.violated == 1));
    }
    printf("]}");
}

static void foreground(const struct scanhub_foreground *f)
{
    unsigned n = 0;
    printf("{\"generation\":%lu,\"count\":%u,\"unit_um\":%lu,\"dropped\":%u,\"beams\":[", (unsigned long)f->generation,
           f->count, (unsigned long)f->unit_um, f->dropped);
    for (unsigned i = 0; i < f->count; i++)
        if (scanhub_is_foreground(f, i))
            printf("%s%u", n++ ? "," : "", i);
    printf("],\"ranges\":[");
    for (unsigned i = 0; i < f->beams; i++)
        printf("%s%u", i ? "," : "", scanhub_foreground_range(f, i));
    printf("],\"segments\":[");
    for (unsigned i = 0; i < f->segment_count; i++) {
        struct scanhub_segment s = scanhub_segment(f, i);
        printf("%s{\"first\":%u,\"last\":%u,\"nearest\":%u,\"width\":%u,\"x_mm\":%ld,\"y_mm\":%ld,\"support\":%s}", i ? "," : "",
               s.first, s.last, s.nearest, s.width, (long)s.x_mm, (long)s.y_mm, boolean(s.support));
    }
    printf("]}");
}

static void background(const struct scanhub_background *b)
{
    printf("{\"generation\":%lu,\"known_beams\":%u,\"count\":%u,\"unit_um\":%lu", (unsigned long)b->generation, b->known_beams,
           b->count, (unsigned long)b->unit_um);
    number(",\"first_angle\":", b->first_angle);
    number(",\"step\":", b->step);
    printf(",\"frozen\":%s,\"ranges\":[", boolean(b->frozen));
    for (unsigned i = 0; i < b->count; i++)
        printf("%s%u", i ? "," : "", scanhub_background_range(b, i));
    printf("]}");
}

static void status(const struct scanhub_status *s)
{
    static const char *const states[] = {"absent", "probing", "switching", "starting", "streaming", "silent", "paused"};
    if (s->state < 7)
        printf("{\"state\":\"%s\"", states[s->state]);
    else
        printf("{\"state\":null");
    printf(",\"family\":%s%s%s", s->family < 3 ? "\"" : "", s->family < 3 ? families[s->family] : "null",
           s->family < 3 ? "\"" : "");
    printf(",\"mode\":%u,\"unit_mm\":%u,\"baud\":%lu,\"since_ns\":%llu,\"rate_mhz\":%lu,\"angle_deg\":%u", s->mode, s->unit_mm, (unsigned long)s->baud,
           (unsigned long long)s->since_ns, (unsigned long)s->rate_mhz, s->angle_deg);
    printf(",\"resolution_cdeg\":%u,\"type\":\"%s\",\"port\":\"%s\",\"last_error\":\"%s\",\"counters\":[", s->resolution_cdeg,
           s->type, s->port, s->last_error);
    for (unsigned i = 0; i < 28; i++)
        printf("%s%llu", i ? "," : "", (unsigned long long)s->counters[i]);
    printf("],\"pose\":{\"x_m\":%.17g,\"y_m\":%.17g,\"yaw_rad\":%.17g,\"upside_down\":%s}}", s->x_m, s->y_m, s->yaw_rad,
           boolean(s->upside_down == 1));
}

/* Reads and prints head and payload of a datagram of one topic. */
#define TOPIC(NUMBER, NAME)                                                                                               \
    case NUMBER: {                                                                                                        \
        struct scanhub_##NAME value;                                                                                      \
        enum scanhub_result result = scanhub_read_##NAME(d, &value);                                                      \
        if (result == SCANHUB_OK) {                                                                                       \
            head(d);                                                                                                      \
            NAME(&value);                                                                                                 \
        }                                                                                                                 \
        return result;                                                                                                    \
    }

static void head(const struct scanhub_datagram *d)
{
    printf("{\"head\":{\"topic\":%u,\"flags\":%u,\"hub\":\"%016llx\",\"epoch\":%lu,\"sequence\":%lu,\"stamp_ns\":%llu,",
           d->topic, d->flags, (unsigned long long)d->hub, (unsigned long)d->epoch, (unsigned long)d->sequence,
           (unsigned long long)d->stamp_ns);
    printf("\"sensor\":%u,\"part\":%u,\"parts\":%u,\"family\":%u,", d->sensor, d->part, d->parts, d->family);
    printf("\"revision\":%u,\"counter\":%lu,\"payload_len\":%lu},", d->revision, (unsigned long)d->counter,
           (unsigned long)d->payload_len);
    printf("\"mac\":%s,\"payload\":", boolean(d->mac != NULL));
}

static enum scanhub_result payload(const struct scanhub_datagram *d)
{
    switch (d->topic) {
        TOPIC(SCANHUB_ANNOUNCE, announce)
        TOPIC(SCANHUB_TELEGRAM, telegram)
        TOPIC(SCANHUB_SCAN, scan)
        TOPIC(SCANHUB_MARKS, marks)
        TOPIC(SCANHUB_ZONES, zones)
        TOPIC(SCANHUB_FOREGROUND, foreground)
        TOPIC(SCANHUB_BACKGROUND, background)
        TOPIC(SCANHUB_STATUS, status)
        TOPIC(SCANHUB_LINES, lines)
        TOPIC(SCANHUB_MOTION, motion)
        TOPIC(SCANHUB_EARLY, early)
        TOPIC(SCANHUB_TRACKS, tracks)
        TOPIC(SCANHUB_EVENTS, events)
        TOPIC(SCANHUB_TILT, tilt)
        TOPIC(SCANHUB_CLOUD, cloud)
        TOPIC(SCANHUB_OBSTACLES, obstacles)
    }
    return SCANHUB_SKIPPED;
}

/* Stores a part of a sample with three parts. Returns 1 and the whole sample once all parts have arrived. */
static int is_whole(struct scanhub_datagram *d)
{
    static uint8_t bytes[3][1424], whole[3 * 1424];
    static uint32_t lengths[3], end;
    unsigned i;
    memcpy(bytes[d->part], d->payload, d->payload_len);
    lengths[d->part] = d->payload_len;
    for (i = end = 0; i < 3; end += lengths[i++]) {
        if (!lengths[i])
            return 0;
        memcpy(whole + end, bytes[i], lengths[i]);
    }
    d->payload = whole;
    d->payload_len = end;
    d->parts = 1;
    return 1;
}

/* Prints the outcome of a datagram. `key` has the 64 digits of the key, `@` and the second of the arrival. */
static void keyed(const char *key, const uint8_t *bytes, size_t len)
{
    static struct scanhub_guard guard;
    struct scanhub_key known;
    struct scanhub_datagram datagram;
    uint64_t wall_ns = strtoull(key + 65, NULL, 10) * 1000000000u;
    enum scanhub_result result;
    int is_part;
    if (!scanhub_key_of(&known, key, 64))
        abort();
    result = scanhub_read_with(&known, bytes, len, &datagram);
    if (result == SCANHUB_OK)
        result = scanhub_guard_take(&guard, &datagram, wall_ns);
    is_part = result == SCANHUB_OK && datagram.parts > 1;
    if (is_part && is_whole(&datagram)) {
        is_part = 0;
        result = scanhub_guard_take(&guard, &datagram, wall_ns);
    }
    printf("{\"outcome\":\"%s\"}\n", result != SCANHUB_OK ? refusals[result] : is_part ? "part" : "taken");
}

static void plain(const uint8_t *bytes, size_t len)
{
    struct scanhub_datagram datagram;
    enum scanhub_result result = scanhub_read(bytes, len, &datagram);
    if (result == SCANHUB_OK)
        result = payload(&datagram);
    if (result == SCANHUB_OK)
        printf("}\n");
    else
        printf("{\"refusal\":\"%s\"}\n", refusals[result]);
}

static void vectors_of_sha(void)
{
    static const uint8_t begin[4] = {0xba, 0x78, 0x16, 0xbf};
    struct scanhub_sha sha;
    struct scanhub_key key;
    uint8_t digest[32];
    scanhub_sha_begin(&sha);
    scanhub_sha_add(&sha, (const uint8_t *)"abc", 3);
    scanhub_sha_end(&sha, digest);
    if (memcmp(digest, begin, 4) != 0)
        abort();
    if (scanhub_key_of(&key, "short", 5) || scanhub_key_of(&key, "", 0) || !scanhub_key_of(&key, digest, 32))
        abort();
}

int main(void)
{
    static char buffer[2 * 65536];
    vectors_of_sha();
    while (fgets(buffer, sizeof buffer, stdin)) {
        const char *key = strchr(buffer, ':') ? buffer : NULL, *line = key ? strchr(buffer, ':') + 1 : buffer;
        size_t len = strspn(line, "0123456789abcdef") / 2;
        /* Allocate exactly this length, so that memory checkers detect reads past the end. */
        uint8_t *bytes = malloc(len ? len : 1);
        if (!bytes)
            return 1;
        for (size_t i = 0; i < len; i++) {
            char digits[3] = {line[2 * i], line[2 * i + 1], 0};
            bytes[i] = (uint8_t)strtoul(digits, NULL, 16);
        }
        if (key)
            keyed(key, bytes, len);
        else
            plain(bytes, len);
        fflush(stdout);
        free(bytes);
    }
    return 0;
}
