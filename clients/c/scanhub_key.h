/*
 * Functions for programs in C that check the MACs of datagrams. They check that a sender with the key sent a datagram,
 * and that the datagram is not a replay. They open no sockets and no files. The code is C99, without heap and without a
 * library, because this header contains SHA-256. docs/datagram.md explains which datagrams a listener with a key
 * accepts.
 *
 *     static struct scanhub_guard guard;
 *     struct scanhub_key key;
 *     scanhub_key_of(&key, bytes_of_the_key_file, their_number);
 *     if (scanhub_read_with(&key, bytes, len, &datagram) == SCANHUB_OK
 *         && scanhub_guard_take(&guard, &datagram, nanoseconds_since_1970) == SCANHUB_OK)
 *         use(&datagram);
 */
#ifndef SCANHUB_KEY_H
#define SCANHUB_KEY_H

#include "scanhub.h"

#ifdef __cplusplus
extern "C" {
#endif

/* State of a SHA-256 (FIPS 180-4), and the bytes of the incomplete block. */
struct scanhub_sha {
    uint32_t state[8];
    uint64_t len;
    uint8_t block[64];
};

static inline uint32_t scanhub_sha_turn(uint32_t x, unsigned by) { return x >> by | x << (32 - by); }

static inline void scanhub_sha_block(uint32_t state[8], const uint8_t *at)
{
    static const uint32_t k[64] = {
        0x428a2f98u, 0x71374491u, 0xb5c0fbcfu, 0xe9b5dba5u, 0x3956c25bu, 0x59f111f1u, 0x923f82a4u, 0xab1c5ed5u,
        0xd807aa98u, 0x12835b01u, 0x243185beu, 0x550c7dc3u, 0x72be5d74u, 0x80deb1feu, 0x9bdc06a7u, 0xc19bf174u,
        0xe49b69c1u, 0xefbe4786u, 0x0fc19dc6u, 0x240ca1ccu, 0x2de92c6fu, 0x4a7484aau, 0x5cb0a9dcu, 0x76f988dau,
        0x983e5152u, 0xa831c66du, 0xb00327c8u, 0xbf597fc7u, 0xc6e00bf3u, 0xd5a79147u, 0x06ca6351u, 0x14292967u,
        0x27b70a85u, 0x2e1b2138u, 0x4d2c6dfcu, 0x53380d13u, 0x650a7354u, 0x766a0abbu, 0x81c2c92eu, 0x92722c85u,
        0xa2bfe8a1u, 0xa81a664bu, 0xc24b8b70u, 0xc76c51a3u, 0xd192e819u, 0xd6990624u, 0xf40e3585u, 0x106aa070u,
        0x19a4c116u, 0x1e376c08u, 0x2748774cu, 0x34b0bcb5u, 0x391c0cb3u, 0x4ed8aa4au, 0x5b9cca4fu, 0x682e6ff3u,
        0x748f82eeu, 0x78a5636fu, 0x84c87814u, 0x8cc70208u, 0x90befffau, 0xa4506cebu, 0xbef9a3f7u, 0xc67178f2u};
    uint32_t w[64], s[8];
    unsigned i;
    for (i = 0; i < 16; i++)
        w[i] = (uint32_t)at[4 * i] << 24 | (uint32_t)at[4 * i + 1] << 16 | (uint32_t)at[4 * i + 2] << 8 | at[4 * i + 3];
    for (i = 16; i < 64; i++) {
        uint32_t a = w[i - 15], b = w[i - 2];
        w[i] = w[i - 16] + (scanhub_sha_turn(a, 7) ^ scanhub_sha_turn(a, 18) ^ a >> 3) + w[i - 7]
            + (scanhub_sha_turn(b, 17) ^ scanhub_sha_turn(b, 19) ^ b >> 10);
    }
    memcpy(s, state, sizeof s);
    for (i = 0; i < 64; i++) {
        uint32_t a = s[0], e = s[4];
        uint32_t first = s[7] + (scanhub_sha_turn(e, 6) ^ scanhub_sha_turn(e, 11) ^ scanhub_sha_turn(e, 25))
            + ((e & s[5]) ^ (~e & s[6])) + k[i] + w[i];
        uint32_t second = (scanhub_sha_turn(a, 2) ^ scanhub_sha_turn(a, 13) ^ scanhub_sha_turn(a, 22))
            + ((a & s[1]) ^ (a & s[2]) ^ (s[1] & s[2]));
        memmove(s + 1, s, 7 * sizeof *s);
        s[4] += first;
        s[0] = first + second;
    }
    for (i = 0; i < 8; i++)
        state[i] += s[i];
}

static inline void scanhub_sha_begin(struct scanhub_sha *sha)
{
    static const uint32_t begin[8] = {0x6a09e667u, 0xbb67ae85u, 0x3c6ef372u, 0xa54ff53au,
                                      0x510e527fu, 0x9b05688cu, 0x1f83d9abu, 0x5be0cd19u};
    memcpy(sha->state, begin, sizeof begin);
    sha->len = 0;
}

static inline void scanhub_sha_add(struct scanhub_sha *sha, const uint8_t *bytes, size_t len)
{
    while (len > 0) {
        size_t at = (size_t)(sha->len % 64), part = len < 64 - at ? len : 64 - at;
        memcpy(sha->block + at, bytes, part);
        sha->len += part;
        bytes += part;
        len -= part;
        if (at + part == 64)
            scanhub_sha_block(sha->state, sha->block);
    }
}

static inline void scanhub_sha_end(struct scanhub_sha *sha, uint8_t out[32])
{
    static const uint8_t padding[64] = {0x80};
    uint64_t bits = 8 * sha->len;
    uint8_t length[8];
    unsigned i;
    for (i = 0; i < 8; i++)
        length[i] = (uint8_t)(bits >> (56 - 8 * i));
    scanhub_sha_add(sha, padding, 1 + (size_t)((119 - sha->len % 64) % 64));
    scanhub_sha_add(sha, length, 8);
    for (i = 0; i < 32; i++)
        out[i] = (uint8_t)(sha->state[i / 4] >> (24 - 8 * (i % 4)));
}

/* A key, as the initial states of the two hashes of a MAC (HMAC, RFC 2104). */
struct scanhub_key {
    struct scanhub_sha inner, outer;
};

static inline int scanhub_key_digit(uint8_t c)
{
    return c >= '0' && c <= '9' ? c - '0' : c >= 'a' && c <= 'f' ? c - 'a' + 10 : c >= 'A' && c <= 'F' ? c - 'A' + 10 : -1;
}

/* Converts the content of a key file, which is 32 bytes, or 64 hex digits with or without an end of line. Returns 1, or
 * 0 if the content is not a key. Before the call, check that no other user can read the file. */
static inline int scanhub_key_of(struct scanhub_key *key, const void *file, size_t len)
{
    const uint8_t *bytes = (const uint8_t *)file;
    uint8_t pad[64] = {0};
    unsigned i;
    if (len == 32)
        memcpy(pad, bytes, 32);
    else {
        while (len > 64 && (bytes[len - 1] == '\n' || bytes[len - 1] == '\r' || bytes[len - 1] == ' '))
            len--;
        if (len != 64)
            return 0;
        for (i = 0; i < 32; i++) {
            int high = scanhub_key_digit(bytes[2 * i]), low = scanhub_key_digit(bytes[2 * i + 1]);
            if (high < 0 || low < 0)
                return 0;
            pad[i] = (uint8_t)(high << 4 | low);
        }
    }
    for (i = 0; i < 64; i++)
        pad[i] ^= 0x36;
    scanhub_sha_begin(&key->inner);
    scanhub_sha_add(&key->inner, pad, 64);
    for (i = 0; i < 64; i++)
        pad[i] ^= 0x36 ^ 0x5c;
    scanhub_sha_begin(&key->outer);
    scanhub_sha_add(&key->outer, pad, 64);
    return 1;
}

/* Returns whether the last 16 bytes of a datagram are its MAC for this key. scanhub_read must have accepted the
 * datagram, and the datagram must have a MAC. The comparison takes constant time. */
static inline int scanhub_is_of(const struct scanhub_key *key, const void *bytes, size_t len)
{
    static const uint8_t no_crc[4] = {0, 0, 0, 0};
    const uint8_t *at = (const uint8_t *)bytes;
    struct scanhub_sha sha = key->inner;
    uint8_t digest[32], differs = 0;
    unsigned i;
    scanhub_sha_add(&sha, at, SCANHUB_DATAGRAM_AT_CRC);
    scanhub_sha_add(&sha, no_crc, 4);
    scanhub_sha_add(&sha, at + SCANHUB_DATAGRAM_AT_END, len - 16 - SCANHUB_DATAGRAM_AT_END);
    scanhub_sha_end(&sha, digest);
    sha = key->outer;
    scanhub_sha_add(&sha, digest, 32);
    scanhub_sha_end(&sha, digest);
    for (i = 0; i < 16; i++)
        differs |= (uint8_t)(digest[i] ^ at[len - 16 + i]);
    return differs == 0;
}

/* Checks a datagram like scanhub_read, and also checks that its sender has `key`. This function does not detect
 * replays: also call scanhub_guard_take. */
static inline enum scanhub_result scanhub_read_with(const struct scanhub_key *key, const void *bytes, size_t len,
                                                    struct scanhub_datagram *out)
{
    enum scanhub_result result = scanhub_read(bytes, len, out);
    if (result != SCANHUB_OK)
        return result;
    if (!out->mac)
        return SCANHUB_BAD_KEY;
    return scanhub_is_of(key, bytes, len) ? SCANHUB_OK : SCANHUB_BAD_MAC;
}

/* Maximum number of gateways. */
#define SCANHUB_HUBS 16
/* Maximum number of topics that the gateways send, including announcements. 16 sensors may have all topics. */
#define SCANHUB_STREAMS (16 * SCANHUB_TOPICS)

/* A gateway, and the greatest epoch that was received from it. */
struct scanhub_run {
    uint64_t hub;
    uint32_t epoch;
};

/* Sequence numbers of a sensor's topic. `highest` is the highest number that was received, and is valid if `any` is 1.
 * `seen` has a bit for each of the 1024 numbers up to `highest`. Numbers below `first` are refused. */
struct scanhub_stream {
    uint64_t hub;
    uint8_t sensor, topic, any;
    uint32_t first, highest;
    uint8_t seen[128];
};

/* State of a reader with the key, 40 kB. Start with all bytes 0. To refuse older runs of gateways even after a restart
 * of your program, save `runs` and `run_count`, and start with the saved values. */
struct scanhub_guard {
    struct scanhub_run runs[SCANHUB_HUBS];
    uint8_t run_count;
    uint16_t stream_count;
    struct scanhub_stream streams[SCANHUB_STREAMS];
};

static inline struct scanhub_stream *scanhub_guard_find(struct scanhub_guard *guard, uint64_t hub, uint8_t sensor,
                                                        uint8_t topic)
{
    unsigned i;
    for (i = 0; i < guard->stream_count; i++) {
        struct scanhub_stream *stream = guard->streams + i;
        if (stream->hub == hub && stream->sensor == sensor && stream->topic == topic)
            return stream;
    }
    return NULL;
}

/* Returns the stream of `topic`. A new stream starts with `first`. Returns NULL if all streams are in use. */
static inline struct scanhub_stream *scanhub_guard_begin(struct scanhub_guard *guard, uint64_t hub, uint8_t sensor,
                                                         uint8_t topic, uint32_t first)
{
    struct scanhub_stream *stream = scanhub_guard_find(guard, hub, sensor, topic);
    if (!stream && guard->stream_count < SCANHUB_STREAMS) {
        stream = guard->streams + guard->stream_count++;
        memset(stream, 0, sizeof *stream);
        stream->hub = hub;
        stream->sensor = sensor;
        stream->topic = topic;
        stream->first = first;
    }
    return stream;
}

/* Returns whether a sequence number is new, stale or a duplicate. With `is_taken`, a new number is stored as
 * received. */
static inline enum scanhub_result scanhub_stream_take(struct scanhub_stream *stream, uint32_t number, int is_taken)
{
    uint8_t bit = (uint8_t)(1u << number % 8), *byte = stream->seen + number / 8 % 128;
    uint32_t behind = stream->highest - number, i;
    int is_behind = stream->any && behind <= 0x80000000u;
    if (is_behind ? behind > stream->highest - stream->first : !stream->any && number - stream->first >= 0x80000000u)
        return SCANHUB_STALE;
    if (is_behind && *byte & bit)
        return SCANHUB_DUPLICATE;
    if (!is_behind && is_taken) {
        /* The numbers between the previous highest one and this one have not arrived, so clear their bits. */
        uint32_t leave = stream->any && number - stream->highest < 1024 ? number - stream->highest : 1024;
        for (i = 0; i < leave; i++)
            stream->seen[(number - i) / 8 % 128] &= (uint8_t) ~(1u << (number - i) % 8);
        stream->highest = number;
        stream->any = 1;
        if (number - stream->first > 1023)
            stream->first = number - 1023;
    }
    if (is_taken)
        *byte |= bit;
    return SCANHUB_OK;
}

/* Checks that a datagram is new and not replayed, after scanhub_read_with has accepted it. `wall_ns` is the current
 * time in ns since 1970. A part is checked, but its number is not stored: when the sample is complete, call this
 * function again for the complete sample, with `parts` 1. */
static inline enum scanhub_result scanhub_guard_take(struct scanhub_guard *guard, const struct scanhub_datagram *datagram,
                                                     uint64_t wall_ns)
{
    struct scanhub_announce announce;
    struct scanhub_run *run = guard->runs;
    struct scanhub_stream *stream;
    uint64_t hub = datagram->hub;
    enum scanhub_result result;
    unsigned i, kept;
    int is_announce = datagram->topic == SCANHUB_ANNOUNCE, is_next;
    while (run < guard->runs + guard->run_count && run->hub != hub)
        run++;
    is_next = run == guard->runs + guard->run_count || run->epoch < datagram->epoch;
    if (!is_next && run->epoch > datagram->epoch)
        return SCANHUB_EPOCH;
    stream = is_next ? NULL : scanhub_guard_find(guard, hub, datagram->sensor, SCANHUB_ANNOUNCE);
    if (!stream) {
        uint64_t apart = wall_ns > datagram->stamp_ns ? wall_ns - datagram->stamp_ns : datagram->stamp_ns - wall_ns;
        if (!is_announce || apart > 5000000000u)
            return SCANHUB_UNTIMELY;
    }
    if (!is_announce) {
        stream = scanhub_guard_find(guard, hub, datagram->sensor, datagram->topic);
        return stream ? scanhub_stream_take(stream, datagram->sequence, datagram->parts == 1) : SCANHUB_UNTIMELY;
    }
    result = scanhub_read_announce(datagram, &announce);
    if (result != SCANHUB_OK)
        return result;
    if (is_next) {
        if (run == guard->runs + SCANHUB_HUBS)
            return SCANHUB_CAPACITY;
        /* A new run of the gateway has begun, so drop the streams of its older runs, which are refused from now on. */
        for (i = kept = 0; i < guard->stream_count; i++)
            if (guard->streams[i].hub != hub)
                guard->streams[kept++] = guard->streams[i];
        guard->stream_count = (uint16_t)kept;
    }
    stream = scanhub_guard_begin(guard, hub, datagram->sensor, SCANHUB_ANNOUNCE, datagram->sequence);
    if (!stream)
        return SCANHUB_CAPACITY;
    if (run == guard->runs + guard->run_count)
        guard->run_count++;
    run->hub = hub;
    run->epoch = datagram->epoch;
    result = scanhub_stream_take(stream, datagram->sequence, 1);
    for (i = 0; result == SCANHUB_OK && i < announce.count; i++) {
        struct scanhub_announced announced = scanhub_announced(&announce, i);
        if (announced.topic != SCANHUB_ANNOUNCE && announced.topic < SCANHUB_TOPICS)
            scanhub_guard_begin(guard, hub, datagram->sensor, announced.topic, announced.next);
    }
    return result;
}

#ifdef __cplusplus
}
#endif

#endif
