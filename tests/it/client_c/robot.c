/* Subscribes to the combined verdict of a robot and prints a line of JSON for each verdict:
 * robot doorbell|event|spin|poll [SENSORS [early]]. */
#include <scanhub/attach.h>

#include <errno.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static void print_text(const char *key, const char *text)
{
    printf(text == NULL ? ",\"%s\":null" : ",\"%s\":\"%s\"", key, text);
}

static void print_mm(uint32_t mm)
{
    if (mm == SCANHUB_NOTHING_MM)
        printf(",\"nearest_mm\":null");
    else
        printf(",\"nearest_mm\":%lu", (unsigned long)mm);
}

static void print(const struct scanhub_sample *sample)
{
    const struct scanhub_robot *robot = sample->payload;
    printf("{\"class\":\"robot\",\"verdict\":%d", robot->verdict);
    print_mm(robot->nearest_mm);
    print_text("worst", robot->worst);
    print_text("nearest_sensor", robot->nearest);
    printf(",\"sensors\":[");
    for (size_t i = 0; i < robot->count; i++) {
        const struct scanhub_robot_sensor *sensor = &robot->sensors[i];
        printf("%s{\"verdict\":%d", i > 0 ? "," : "", sensor->verdict);
        print_text("sensor", sensor->name);
        print_mm(sensor->nearest_mm);
        printf("}");
    }
    printf("]}\n");
    fflush(stdout);
}

static int fail(const char *what)
{
    fprintf(stderr, "%s: %s\n", what, scanhub_error());
    return EXIT_FAILURE;
}

int main(int argc, char **argv)
{
    if (argc < 2)
        return EXIT_FAILURE;
    const int polls = strcmp(argv[1], "poll") == 0;
    const int wait = polls || strcmp(argv[1], "event") == 0 ? SCANHUB_WAIT_EVENT
        : strcmp(argv[1], "spin") == 0                      ? SCANHUB_WAIT_SPIN
                                                            : SCANHUB_WAIT_DOORBELL;
    struct scanhub_attachment *robot;
    struct scanhub_sample sample;
    const char *sensors = argc > 2 ? argv[2] : NULL;
    const int early = argc > 3 && strcmp(argv[3], "early") == 0;
    if ((early ? scanhub_open_robot_early : scanhub_open_robot)(&robot, NULL, sensors, wait) != 0)
        return fail("open");
    struct pollfd fds = {polls ? scanhub_fd(robot) : -1, POLLIN, 0};
    for (;;) {
        if (polls && poll(&fds, 1, -1) < 0 && errno != EINTR)
            return EXIT_FAILURE;
        if (!polls && scanhub_wait(robot, -1) != 1)
            return fail("wait");
        int taken;
        while ((taken = scanhub_take(robot, &sample)) == 1) {
            if (sample.header != NULL || sample.length != sizeof(struct scanhub_robot))
                return EXIT_FAILURE;
            print(&sample);
            if (scanhub_release(&sample) != 0)
                return fail("release");
        }
        if (taken < 0)
            return fail("take");
    }
}
