/* Publishes the angles of a simulated mount: mount [NAME]. The mount swings by half a radian and back in two seconds.
 * The program needs POSIX clocks. */
#define _POSIX_C_SOURCE 200112L
#include <scanhub/attach.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

static uint64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000000 + (uint64_t)now.tv_nsec;
}

/* Returns the angle of the encoder in radians, right-handed around the axis. */
static double angle_rad(uint64_t at_ns)
{
    const double phase = (double)(at_ns % 2000000000) / 1e9;
    return 0.5 * (phase < 1.0 ? phase : 2.0 - phase);
}

int main(int argc, char **argv)
{
    const struct timespec pause = {0, 10000000};
    struct scanhub_publication *mount;
    int answer = scanhub_publish_tilt(&mount, NULL, argc > 1 ? argv[1] : "mount");

    while (answer == 0) {
        const uint64_t at_ns = now_ns();
        answer = scanhub_send_tilt(mount, at_ns, angle_rad(at_ns), NAN);
        nanosleep(&pause, NULL);
    }
    fprintf(stderr, "mount: %s\n", scanhub_error());
    scanhub_unpublish(mount);
    return EXIT_FAILURE;
}
