/* Subscribes to scans and prints a line of JSON ten times a second, with the reason for the silence and the existing names:
 * silence SENSOR doorbell|event. With `event`, it prints a line only after a timeout of poll, which is half a second. The line
 * has the number of wake-ups without a sample. */
#include <scanhub/attach.h>

#include <inttypes.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static void refused(void)
{
    fprintf(stderr, "%s\n", scanhub_error());
    exit(EXIT_FAILURE);
}

static void print_text(const char *key, const char *text)
{
    printf(",\"%s\":\"", key);
    for (; *text != '\0'; text++) {
        if (*text == '\n')
            printf("\\n");
        else
            printf(*text == '"' || *text == '\\' ? "\\%c" : "%c", *text);
    }
    printf("\"");
}

static void print_names(const char *key, int (*list)(const char *, char *, size_t))
{
    char names[4096];
    if (list(NULL, names, sizeof names) < 0)
        refused();
    print_text(key, names);
}

/* Waits for a sample, at most for the time between two lines. Returns the number of wake-ups without a sample. */
static int wait_for_line(struct scanhub_attachment *scans, int is_event)
{
    struct scanhub_sample sample;
    int wakeups = 0;
    if (!is_event) {
        if (scanhub_wait(scans, 100) < 0)
            refused();
    } else {
        struct pollfd fd = {scanhub_fd(scans), POLLIN, 0};
        while (poll(&fd, 1, 500) == 1) {
            int taken = scanhub_take(scans, &sample);
            if (taken < 0)
                refused();
            if (taken == 1) {
                scanhub_release(&sample);
                break;
            }
            wakeups++;
        }
    }
    while (scanhub_take(scans, &sample) == 1)
        scanhub_release(&sample);
    return wakeups;
}

int main(int argc, char **argv)
{
    struct scanhub_attachment *scans;
    const int is_event = argc > 2 && strcmp(argv[2], "event") == 0;
    const int wait = is_event ? SCANHUB_WAIT_EVENT : SCANHUB_WAIT_DOORBELL;
    if (scanhub_open(&scans, NULL, argc > 1 ? argv[1] : "front", SCANHUB_TOPIC_SCAN, wait) != 0)
        refused();
    for (;;) {
        uint64_t silent_ns;
        const char *text;
        int wakeups = wait_for_line(scans, is_event);
        int reason = scanhub_why_silent(scans, &text);
        if (reason < 0 || scanhub_silent_for(scans, &silent_ns) != 0)
            refused();
        printf("{\"class\":\"silence\",\"reason\":%d,\"silent_ns\":%" PRIu64 ",\"wakeups\":%d", reason, silent_ns, wakeups);
        print_text("text", text);
        print_names("sensors", scanhub_sensors);
        print_names("topics", scanhub_topics);
        printf("}\n");
        fflush(stdout);
    }
}
