/* Reads datagrams with clients/c/scanhub.h: a line of hex digits in, a line of JSON out, in the words of the list of golden
 * datagrams. */
#include "scanhub.h"

#include <stdio.h>
#include <stdlib.h>

static const char *const refusals[] = {"", "short", "magic", "version", "header", "length", "crc", "skipped", "payload"};

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

/* With as few digits as say the number and no other, and a point; JSON has neither nan nor infinity. */
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

static const char *const families[] = {"lms", "ld"};

static void scan(const struct scanhub_scan *s)
{
    printf("{\"family\":%s%s%s", s->family < 2 ? "\"" : "", s->family < 2 ? families[s->family] : "null",
           s->family < 2 ? "\"" : "");
    printf(",\"unit_um\":%lu,\"count\":%u", (unsigned long)s->unit_um, s->count);
    number(",\"first_angle\":", s->first_angle);
    number(",\"step\":", s->step);
    number(",\"spacing\":", s->spacing);
    printf(",\"beam_time_ns\":%lu,\"valid_to\":%u,\"no_return\":%u,\"beyond\":%u,\"collapsed\":%u,\"incomplete\":%s",
           (unsigned long)s->beam_time_ns, s->valid_to, s->no_return, s->beyond, s->collapsed, boolean(s->incomplete));
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
    printf("{\"generation\":%lu,\"count\":%u,\"unit_um\":%lu,\"left_out\":%u,\"beams\":[", (unsigned long)f->generation,
           f->count, (unsigned long)f->unit_um, f->left_out);
    for (unsigned i = 0; i < f->count; i++)
        if (scanhub_is_foreground(f, i))
            printf("%s%u", n++ ? "," : "", i);
    printf("],\"ranges\":[");
    for (unsigned i = 0; i < f->beams; i++)
        printf("%s%u", i ? "," : "", scanhub_foreground_range(f, i));
    printf("],\"segments\":[");
    for (unsigned i = 0; i < f->segment_count; i++) {
        struct scanhub_segment s = scanhub_segment(f, i);
        printf("%s{\"first\":%u,\"last\":%u,\"nearest\":%u,\"width\":%u,\"x_mm\":%ld,\"y_mm\":%ld}", i ? "," : "", s.first,
               s.last, s.nearest, s.width, (long)s.x_mm, (long)s.y_mm);
    }
    printf("]}");
}

static void background(const struct scanhub_background *b)
{
    printf("{\"generation\":%lu,\"taught\":%u,\"count\":%u,\"unit_um\":%lu", (unsigned long)b->generation, b->taught,
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
    printf(",\"family\":%s%s%s", s->family < 2 ? "\"" : "", s->family < 2 ? families[s->family] : "null",
           s->family < 2 ? "\"" : "");
    printf(",\"mode\":%u,\"unit_mm\":%u,\"baud\":%lu,\"since_ns\":%llu,\"rate_mhz\":%lu,\"angle_deg\":%u", s->mode, s->unit_mm, (unsigned long)s->baud,
           (unsigned long long)s->since_ns, (unsigned long)s->rate_mhz, s->angle_deg);
    printf(",\"resolution_cdeg\":%u,\"type\":\"%s\",\"port\":\"%s\",\"last_error\":\"%s\",\"counters\":[", s->resolution_cdeg,
           s->type, s->port, s->last_error);
    for (unsigned i = 0; i < 28; i++)
        printf("%s%llu", i ? "," : "", (unsigned long long)s->counters[i]);
    printf("],\"pose\":{\"x_m\":%.17g,\"y_m\":%.17g,\"yaw_rad\":%.17g,\"upside_down\":%s}}", s->x_m, s->y_m, s->yaw_rad,
           boolean(s->upside_down == 1));
}

/* Reads and prints the payload of one topic, behind `prefix`. */
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
    }
    return SCANHUB_SKIPPED;
}

int main(void)
{
    static char line[2 * 65536];
    while (fgets(line, sizeof line, stdin)) {
        size_t len = strspn(line, "0123456789abcdef") / 2;
        /* Of its very length, so that a tool that watches memory sees whoever reads behind it. */
        uint8_t *bytes = malloc(len ? len : 1);
        struct scanhub_datagram datagram;
        enum scanhub_result result;
        if (!bytes)
            return 1;
        for (size_t i = 0; i < len; i++) {
            char digits[3] = {line[2 * i], line[2 * i + 1], 0};
            bytes[i] = (uint8_t)strtoul(digits, NULL, 16);
        }
        result = scanhub_read(bytes, len, &datagram);
        if (result == SCANHUB_OK)
            result = payload(&datagram);
        if (result == SCANHUB_OK)
            printf("}\n");
        else
            printf("{\"refusal\":\"%s\"}\n", refusals[result]);
        fflush(stdout);
        free(bytes);
    }
    return 0;
}
