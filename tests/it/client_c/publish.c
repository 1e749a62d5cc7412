/* Publishes the angles of a mount: publish NAME. Each line of stdin has the angle, the rate and the stamp (0 for now) of
 * a sample. Prints a line when it starts to publish and after each sample. Exits at the end of stdin. */
#include <scanhub/attach.h>

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>

int main(int argc, char **argv)
{
    struct scanhub_publication *mount;
    double angle_rad, rate_rad_s;
    uint64_t stamp_ns;
    if (scanhub_publish_tilt(&mount, NULL, argc > 1 ? argv[1] : NULL) != 0) {
        fprintf(stderr, "%s\n", scanhub_error());
        return EXIT_FAILURE;
    }
    puts("{\"class\":\"open\"}");
    fflush(stdout);
    while (scanf("%lf %lf %" SCNu64, &angle_rad, &rate_rad_s, &stamp_ns) == 3) {
        if (scanhub_send_tilt(mount, stamp_ns, angle_rad, rate_rad_s) != 0) {
            fprintf(stderr, "%s\n", scanhub_error());
            return EXIT_FAILURE;
        }
        puts("{\"class\":\"sent\"}");
        fflush(stdout);
    }
    return scanhub_unpublish(mount) == 0 ? EXIT_SUCCESS : EXIT_FAILURE;
}
