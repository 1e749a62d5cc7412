/* The nearest beam of every scan: nearest [SENSOR] [COUNT]. */
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
        const struct scanhub_scan_v1 *scan = sample.payload;
        int32_t nearest_mm = -1;
        unsigned at = 0;
        for (unsigned i = 0; i < scan->count; i++) {
            int32_t mm = scanhub_distance_mm(scan, i);
            if (mm >= 0 && (nearest_mm < 0 || mm < nearest_mm)) {
                nearest_mm = mm;
                at = i;
            }
        }
        if (nearest_mm >= 0)
            printf("%d mm at %.1f degrees\n", (int)nearest_mm, scanhub_angle_mdeg(scan, at) / 1000.0);
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
