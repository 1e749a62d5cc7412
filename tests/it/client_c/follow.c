/*
 * Subscribes to a topic and prints a line of JSON for each sample: follow SENSOR TOPIC doorbell|event|spin|poll COUNT. If
 * COUNT is 0, it runs until it is ended. It uses /proc to find out whether the address of a sample is in shared memory.
 */
#include <scanhub/attach.h>

#include <errno.h>
#include <inttypes.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static int is_shared(const void *address)
{
    char line[512];
    int found = 0;
    FILE *maps = fopen("/proc/self/maps", "r");
    while (maps != NULL && fgets(line, sizeof line, maps) != NULL) {
        uintptr_t from, to;
        if (sscanf(line, "%" SCNxPTR "-%" SCNxPTR, &from, &to) == 2 && (uintptr_t)address >= from
            && (uintptr_t)address < to)
            found = strstr(line, "/dev/shm/") != NULL;
    }
    if (maps != NULL)
        fclose(maps);
    return found;
}

static void print(const struct scanhub_sample *sample)
{
    const unsigned char *bytes = sample->payload;
    printf("{\"class\":\"sample\",\"missed\":%" PRIu64 ",\"restarted\":%d,\"stale\":%d,\"shared\":%s", sample->missed,
           sample->restarted, sample->stale, is_shared(sample->payload) ? "true" : "false");
    if (sample->header != NULL)
        printf(",\"seq\":%" PRIu64 ",\"topic_seq\":%" PRIu64 ",\"boot\":\"%016" PRIx64 "\",\"stamp_ns\":%" PRIu64,
               sample->header->seq, sample->header->topic_seq, sample->header->boot, sample->header->stamp_first_ns);
    printf(",\"data\":\"");
    for (size_t i = 0; i < sample->length; i++)
        printf("%02x", bytes[i]);
    printf("\"}\n");
    fflush(stdout);
}

static int fail(const char *what)
{
    fprintf(stderr, "%s: %s\n", what, scanhub_error());
    return EXIT_FAILURE;
}

int main(int argc, char **argv)
{
    if (argc != 5)
        return EXIT_FAILURE;
    const int polls = strcmp(argv[3], "poll") == 0;
    const int wait = polls || strcmp(argv[3], "event") == 0 ? SCANHUB_WAIT_EVENT
        : strcmp(argv[3], "spin") == 0                      ? SCANHUB_WAIT_SPIN
                                                            : SCANHUB_WAIT_DOORBELL;
    const long count = atol(argv[4]);
    struct scanhub_attachment *topic;
    struct scanhub_sample sample;
    if (scanhub_open(&topic, NULL, argv[1], atoi(argv[2]), wait) != 0)
        return fail("open");
    printf("{\"class\":\"open\",\"version\":\"%s\"}\n", scanhub_version());
    fflush(stdout);
    const int descriptor = polls ? scanhub_fd(topic) : -1;
    if (polls && descriptor < 0)
        return fail("fd");
    long received = 0;
    while (count == 0 || received < count) {
        if (polls) {
            struct pollfd fds = {descriptor, POLLIN, 0};
            if (poll(&fds, 1, -1) < 0 && errno != EINTR)
                return EXIT_FAILURE;
            if (scanhub_fd(topic) != descriptor)
                return fail("another descriptor");
        } else if (scanhub_wait(topic, -1) != 1) {
            return fail("wait");
        }
        int taken;
        while ((count == 0 || received < count) && (taken = scanhub_take(topic, &sample)) != 0) {
            if (taken < 0)
                return fail("take");
            print(&sample);
            received++;
            if (scanhub_release(&sample) != 0)
                return fail("release");
        }
    }
    return scanhub_close(topic) == 0 ? EXIT_SUCCESS : fail("close");
}
