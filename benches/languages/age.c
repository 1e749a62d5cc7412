/*
 * Receives COUNT scans of a sensor, and then prints for each the age of its telegram's last byte on receipt:
 * `aged SENSOR NS`. Arguments: DOMAIN SENSOR COUNT.
 */
#include <scanhub/attach.h>

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

int main(int argc, char **argv)
{
    struct scanhub_attachment *scans;
    struct scanhub_sample sample;
    const size_t count = argc == 4 ? (size_t)atol(argv[3]) : 0;
    uint64_t *const ages = calloc(count + 1, sizeof *ages);
    if (ages == NULL || count == 0)
        return EXIT_FAILURE;
    if (scanhub_open(&scans, argv[1], argv[2], SCANHUB_TOPIC_SCAN, SCANHUB_WAIT_DOORBELL) != 0) {
        fprintf(stderr, "%s\n", scanhub_error());
        return EXIT_FAILURE;
    }
    printf("attaching %s\n", argv[2]);
    fflush(stdout);
    for (size_t i = 0; i < count; i++) {
        struct timespec now;
        if (scanhub_wait(scans, -1) != 1 || scanhub_take(scans, &sample) != 1) {
            fprintf(stderr, "%s\n", scanhub_error());
            return EXIT_FAILURE;
        }
        clock_gettime(CLOCK_MONOTONIC, &now);
        ages[i] = (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec - sample.header->stamp_last_ns;
        scanhub_release(&sample);
    }
    for (size_t i = 0; i < count; i++)
        printf("aged %s %" PRIu64 "\n", argv[2], ages[i]);
    puts("end");
    free(ages);
    return scanhub_close(scans) == 0 ? EXIT_SUCCESS : EXIT_FAILURE;
}
