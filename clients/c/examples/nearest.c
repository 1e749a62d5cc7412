/* Prints the nearest beam of every scan: nearest [SENSOR] [COUNT]. */
#include <scanhub/attach.h>
#include <stdio.h>
#include <stdlib.h>

int main(int argc, char **argv)
{
    const char *sensor = argc > 1 ? argv[1] : "front";
    long left = argc > 2 ? atol(argv[2]) : -1;
    struct scanhub_attachment *scans;
    struct scanhub_sample sample;
    int answer = scanhub_open(&scans, NULL, sensor, SCANHUB_TOPIC_SCAN, SCANHUB_WAIT_DOORBELL);

    while (answer >= 0 && left != 0) {
        answer = scanhub_wait(scans, -1);
        if (answer == 1)
            answer = scanhub_take(scans, &sample);
        if (answer != 1)
            continue;
        double nearest_m = INFINITY;
        unsigned at = 0;
        for (unsigned i = 0; i < scanhub_count(&sample); i++) {
            const double range_m = scanhub_range_m(&sample, i);
            /* If there is no reading, the range is NAN, and this comparison is false. */
            if (range_m < nearest_m) {
                nearest_m = range_m;
                at = i;
            }
        }
        if (nearest_m < INFINITY)
            printf("%.3f m at %.1f degrees\n", nearest_m, scanhub_angle(&sample, at) * 180 / 3.14159265358979);
        fflush(stdout);
        if (left > 0)
            left--;
        scanhub_release(&sample);
    }
    if (answer < 0)
        fprintf(stderr, "nearest: %s\n", scanhub_error());
    scanhub_close(scans);
    return answer < 0 ? EXIT_FAILURE : EXIT_SUCCESS;
}
