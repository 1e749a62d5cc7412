/* Misuses each function of the library and checks the errors that it returns: misuse SENSOR. It needs a running hub. */
#include <scanhub/attach.h>

#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/time.h>
#include <sys/wait.h>
#include <unistd.h>

#define MUST(what)                                                                                   \
    do {                                                                                             \
        if (!(what)) {                                                                               \
            fprintf(stderr, "%s:%d: %s: %s\n", __FILE__, __LINE__, #what, scanhub_error());          \
            exit(EXIT_FAILURE);                                                                      \
        }                                                                                            \
    } while (0)
/* Timeout of a wait, in milliseconds. It is so long that it only ends a program that hangs. */
#define PATIENCE_MS 60000
#define SAYS(text) MUST(strstr(scanhub_error(), text) != NULL)

static struct scanhub_attachment *open_scans(const char *sensor, int wait)
{
    struct scanhub_attachment *handle;
    MUST(scanhub_open(&handle, NULL, sensor, SCANHUB_TOPIC_SCAN, wait) == 0);
    return handle;
}

static void names(const char *sensor)
{
    struct scanhub_attachment *handle;
    MUST(strcmp(scanhub_error(), "") == 0);
    MUST(scanhub_open(NULL, NULL, sensor, SCANHUB_TOPIC_SCAN, 0) == SCANHUB_REFUSED_ARGUMENT);
    SAYS("NULL");
    MUST(scanhub_open(&handle, NULL, NULL, SCANHUB_TOPIC_SCAN, 0) == SCANHUB_REFUSED_ARGUMENT);
    MUST(handle == NULL);
    SAYS("no sensor");
    for (int topic = -1; topic <= 255; topic += 256) {
        MUST(scanhub_open(&handle, NULL, sensor, topic, 0) == SCANHUB_REFUSED_ARGUMENT);
        SAYS("SCANHUB_TOPIC_");
    }
    MUST(scanhub_open(&handle, NULL, sensor, SCANHUB_TOPIC_SCAN, 3) == SCANHUB_REFUSED_ARGUMENT);
    MUST(scanhub_open(&handle, NULL, "\xff", SCANHUB_TOPIC_SCAN, 0) == SCANHUB_REFUSED_ARGUMENT);
    MUST(scanhub_open(&handle, NULL, "Front", SCANHUB_TOPIC_SCAN, 0) == SCANHUB_REFUSED_CONFIGURATION);
    SAYS("\"Front\" is not possible\n  1 to 24 of a-z");
    MUST(scanhub_open_robot(NULL, NULL, NULL, 0) == SCANHUB_REFUSED_ARGUMENT);
    MUST(scanhub_open_robot(&handle, NULL, NULL, 3) == SCANHUB_REFUSED_ARGUMENT && handle == NULL);
    SAYS("SCANHUB_WAIT_");
    MUST(scanhub_open_robot_early(&handle, NULL, NULL, 3) == SCANHUB_REFUSED_ARGUMENT && handle == NULL);
    MUST(scanhub_open_robot(&handle, NULL, "front Front", 0) == SCANHUB_REFUSED_CONFIGURATION && handle == NULL);
    SAYS("\"Front\" is not possible");
    MUST(scanhub_open(&handle, "no/domain", sensor, SCANHUB_TOPIC_SCAN, 0) == SCANHUB_REFUSED_CONFIGURATION);
    MUST(handle == NULL);
}

static void refused_as_a_handle(struct scanhub_attachment *handle)
{
    struct scanhub_sample sample;
    MUST(scanhub_fd(handle) == SCANHUB_REFUSED_ARGUMENT);
    SAYS("no such handle");
    MUST(scanhub_wait(handle, 0) == SCANHUB_REFUSED_ARGUMENT);
    MUST(scanhub_take(handle, &sample) == SCANHUB_REFUSED_ARGUMENT);
    MUST(sample.header == NULL && sample.payload == NULL && scanhub_release(&sample) == 0);
    MUST(scanhub_hub_is_running(handle) == SCANHUB_REFUSED_ARGUMENT);
    uint64_t silent_ns = 1;
    MUST(scanhub_silent_for(handle, &silent_ns) == SCANHUB_REFUSED_ARGUMENT && silent_ns == 0);
    const char *text = NULL;
    MUST(scanhub_why_silent(handle, NULL) == SCANHUB_REFUSED_ARGUMENT);
    MUST(scanhub_why_silent(handle, &text) == SCANHUB_REFUSED_ARGUMENT && text[0] == '\0');
}

static void handles(const char *sensor)
{
    struct scanhub_attachment *handle = open_scans(sensor, SCANHUB_WAIT_DOORBELL);
    int on_the_stack;
    refused_as_a_handle(NULL);
    refused_as_a_handle((struct scanhub_attachment *)&on_the_stack);
    MUST(scanhub_close((struct scanhub_attachment *)&on_the_stack) == SCANHUB_REFUSED_ARGUMENT);
    MUST(scanhub_close(NULL) == 0);
    MUST(scanhub_fd(handle) == SCANHUB_REFUSED_CONFIGURATION);
    SAYS("SCANHUB_WAIT_EVENT");
    MUST(scanhub_take(handle, NULL) == SCANHUB_REFUSED_ARGUMENT);
    MUST(scanhub_take(handle, (struct scanhub_sample *)((char *)&handle + 1)) == SCANHUB_REFUSED_ARGUMENT);
    SAYS("aligned");
    MUST(scanhub_silent_for(handle, NULL) == SCANHUB_REFUSED_ARGUMENT);
    MUST(scanhub_why_silent(handle, NULL) >= 0);
    MUST(scanhub_close(handle) == 0);
    refused_as_a_handle(handle);
    MUST(scanhub_close(handle) == SCANHUB_REFUSED_ARGUMENT);
}

static void names_that_exist(void)
{
    char buffer[64], guarded[8];
    const char *text;
    struct scanhub_attachment *robot;
    MUST(scanhub_sensors(NULL, NULL, 0) == 5 && scanhub_sensors(NULL, buffer, sizeof buffer) == 5);
    MUST(strcmp(buffer, "front") == 0);
    MUST(scanhub_sensors(NULL, buffer, 6) == 5 && strcmp(buffer, "front") == 0);
    MUST(scanhub_sensors(NULL, buffer, 5) == 5 && buffer[0] == '\0');
    memset(guarded, 'x', sizeof guarded);
    MUST(scanhub_topics(NULL, guarded, 1) > 20 && guarded[0] == '\0' && guarded[1] == 'x');
    MUST(scanhub_topics(NULL, buffer, sizeof buffer) >= (int)sizeof buffer);
    MUST(strncmp(buffer, "front/", 6) == 0 && strlen(buffer) < sizeof buffer && strrchr(buffer, '/')[1] != '\0');
    MUST(scanhub_sensors("no-hub-is-here", buffer, sizeof buffer) == 0 && buffer[0] == '\0');
    MUST(scanhub_sensors(NULL, NULL, 1) == SCANHUB_REFUSED_ARGUMENT);
    MUST(scanhub_topics("no/domain", buffer, sizeof buffer) == SCANHUB_REFUSED_CONFIGURATION);
    MUST(scanhub_open_robot(&robot, NULL, NULL, 0) == 0);
    MUST(scanhub_why_silent(robot, &text) == SCANHUB_SILENCE_WAITING && text[0] != '\0');
    struct scanhub_attachment *mistyped;
    MUST(scanhub_open_robot(&mistyped, NULL, "frnot", 0) == 0);
    MUST(scanhub_why_silent(mistyped, &text) == SCANHUB_SILENCE_UNKNOWN_SENSOR && strstr(text, "frnot") != NULL);
    MUST(scanhub_close(mistyped) == 0);
    MUST(scanhub_close(robot) == 0);
}

static void refused_as_a_publication(struct scanhub_publication *publication)
{
    MUST(scanhub_send_tilt(publication, 0, 0.5, NAN) == SCANHUB_REFUSED_ARGUMENT);
    SAYS("no such handle");
}

static struct scanhub_publication *publish(const char *name)
{
    struct scanhub_publication *publication;
    MUST(scanhub_publish_tilt(&publication, NULL, name) == 0);
    return publication;
}

static void *publishes_elsewhere(void *publication)
{
    refused_as_a_publication(publication);
    MUST(scanhub_unpublish(publication) == SCANHUB_REFUSED_ARGUMENT);
    /* The publication ends with the thread that created it. */
    publish("third");
    return NULL;
}

static void publications(const char *sensor)
{
    struct scanhub_publication *mount;
    int status;
    MUST(scanhub_publish_tilt(NULL, NULL, "mount") == SCANHUB_REFUSED_ARGUMENT);
    MUST(scanhub_publish_tilt(&mount, NULL, NULL) == SCANHUB_REFUSED_ARGUMENT && mount == NULL);
    SAYS("no mount");
    MUST(scanhub_publish_tilt(&mount, "no/domain", "mount") == SCANHUB_REFUSED_CONFIGURATION && mount == NULL);
    MUST(scanhub_publish_tilt(&mount, NULL, "robot1.mount") == SCANHUB_REFUSED_CONFIGURATION && mount == NULL);
    MUST(scanhub_publish_tilt(&mount, NULL, sensor) == SCANHUB_REFUSED_FAILED && mount == NULL);
    SAYS("is published by process ");
    mount = publish("mount");
    struct scanhub_publication *second = publish("second"), *again;
    MUST(scanhub_publish_tilt(&again, NULL, "mount") == SCANHUB_REFUSED_FAILED && again == NULL);
    SAYS("the name mount is published by process ");
    MUST(scanhub_send_tilt(mount, 0, 0.5, NAN) == 0 && scanhub_send_tilt(second, 1, 0.5, 0.1) == 0);
    /* An attachment is not a valid publication, and a publication is not a valid attachment. */
    struct scanhub_attachment *angles;
    struct scanhub_sample sample;
    MUST(scanhub_open(&angles, NULL, "mount", SCANHUB_TOPIC_TILT, SCANHUB_WAIT_DOORBELL) == 0);
    refused_as_a_publication((struct scanhub_publication *)angles);
    refused_as_a_handle((struct scanhub_attachment *)mount);
    MUST(scanhub_close((struct scanhub_attachment *)mount) == SCANHUB_REFUSED_ARGUMENT);
    MUST(scanhub_unpublish((struct scanhub_publication *)angles) == SCANHUB_REFUSED_ARGUMENT);
    MUST(scanhub_take(angles, &sample) == 0);
    MUST(scanhub_send_tilt(mount, 7, -0.5, 2) == 0);
    MUST(scanhub_wait(angles, PATIENCE_MS) == 1 && scanhub_take(angles, &sample) == 1);
    const struct scanhub_tilt_v2 *tilt = sample.payload;
    MUST(sample.length == sizeof *tilt && sample.header->stamp_first_ns == 7 && sample.header->stamp_last_ns == 7);
    MUST(sample.header->topic_seq == 1 && tilt->angle_rad == -0.5 && tilt->rate_rad_s == 2);
    MUST(scanhub_close(angles) == 0);
    refused_as_a_publication(NULL);
    pthread_t thread;
    MUST(pthread_create(&thread, NULL, publishes_elsewhere, mount) == 0 && pthread_join(thread, NULL) == 0);
    MUST(scanhub_unpublish(publish("third")) == 0);
    /* A child process cannot use the publication of its parent. */
    const pid_t child = fork();
    MUST(child >= 0);
    if (child == 0) {
        refused_as_a_publication(mount);
        MUST(scanhub_unpublish(mount) == SCANHUB_REFUSED_ARGUMENT);
        exit(EXIT_SUCCESS);
    }
    MUST(waitpid(child, &status, 0) == child && WIFEXITED(status) && WEXITSTATUS(status) == EXIT_SUCCESS);
    MUST(scanhub_send_tilt(mount, 0, 0.5, NAN) == 0);
    MUST(scanhub_unpublish(mount) == 0 && scanhub_unpublish(NULL) == 0);
    refused_as_a_publication(mount);
    MUST(scanhub_unpublish(mount) == SCANHUB_REFUSED_ARGUMENT);
    /* The name `mount` is free again. The publication `second` remains until the process exits. */
    MUST(scanhub_unpublish(publish("mount")) == 0);
}

static void *elsewhere(void *handle)
{
    MUST(strcmp(scanhub_error(), "") == 0);
    refused_as_a_handle(handle);
    SAYS("in the thread that opened it");
    return NULL;
}

static void *releases(void *sample)
{
    MUST(scanhub_release(sample) == SCANHUB_REFUSED_ARGUMENT);
    SAYS("in the thread that opened it");
    return NULL;
}

static void *leaves_it_open(void *sensor)
{
    struct scanhub_sample sample;
    struct scanhub_attachment *handle = open_scans(sensor, SCANHUB_WAIT_EVENT);
    MUST(scanhub_wait(handle, PATIENCE_MS) == 1 && scanhub_take(handle, &sample) == 1);
    return NULL;
}

static void threads(const char *sensor)
{
    char name[32];
    snprintf(name, sizeof name, "%s", sensor);
    struct scanhub_attachment *handle = open_scans(sensor, SCANHUB_WAIT_DOORBELL);
    pthread_t thread;
    MUST(pthread_create(&thread, NULL, elsewhere, handle) == 0 && pthread_join(thread, NULL) == 0);
    struct scanhub_sample sample;
    MUST(scanhub_wait(handle, PATIENCE_MS) == 1 && scanhub_take(handle, &sample) == 1);
    MUST(pthread_create(&thread, NULL, releases, &sample) == 0 && pthread_join(thread, NULL) == 0);
    /* The sample is still valid, and the thread that took it can release it. */
    MUST(sample.payload != NULL && scanhub_release(&sample) == 0 && sample.payload == NULL);
    MUST(scanhub_close(handle) == 0);
    MUST(pthread_create(&thread, NULL, leaves_it_open, name) == 0 && pthread_join(thread, NULL) == 0);
}

/* A child process that exits normally does not affect the attachment of its parent. */
static void children(const char *sensor)
{
    struct scanhub_attachment *handle = open_scans(sensor, SCANHUB_WAIT_EVENT);
    struct scanhub_sample sample;
    int status;
    MUST(scanhub_wait(handle, PATIENCE_MS) == 1 && scanhub_take(handle, &sample) == 1);
    const pid_t child = fork();
    MUST(child >= 0);
    if (child == 0) {
        MUST(scanhub_release(&sample) == SCANHUB_REFUSED_ARGUMENT);
        refused_as_a_handle(handle);
        MUST(scanhub_close(handle) == SCANHUB_REFUSED_ARGUMENT);
        exit(EXIT_SUCCESS);
    }
    MUST(waitpid(child, &status, 0) == child && WIFEXITED(status) && WEXITSTATUS(status) == EXIT_SUCCESS);
    MUST(scanhub_release(&sample) == 0);
    for (int i = 0; i < 20; i++) {
        MUST(scanhub_wait(handle, PATIENCE_MS) == 1 && scanhub_take(handle, &sample) == 1);
        MUST(scanhub_release(&sample) == 0);
    }
    MUST(scanhub_close(handle) == 0);
}

/* After scanhub_wait has reported a sample, poll still reports it until it is taken. */
static void polls(const char *sensor)
{
    struct scanhub_attachment *handle = open_scans(sensor, SCANHUB_WAIT_EVENT);
    struct scanhub_sample sample;
    struct pollfd fds = {scanhub_fd(handle), POLLIN, 0};
    MUST(fds.fd >= 0 && scanhub_wait(handle, PATIENCE_MS) == 1);
    while (scanhub_take(handle, &sample) == 1)
        MUST(scanhub_release(&sample) == 0);
    MUST(scanhub_wait(handle, PATIENCE_MS) == 1);
    MUST(poll(&fds, 1, 0) == 1);
    MUST(scanhub_close(handle) == 0);
}

static void samples(const char *sensor)
{
    struct scanhub_attachment *handle = open_scans(sensor, SCANHUB_WAIT_DOORBELL);
    struct scanhub_sample lent[4], fifth, copy;
    for (int i = 0; i < 4; i++) {
        MUST(scanhub_wait(handle, PATIENCE_MS) == 1);
        MUST(scanhub_take(handle, &lent[i]) == 1 && lent[i].length == sizeof(struct scanhub_scan_v2) + 3 * 361);
        MUST(i == 0 || lent[i].header->topic_seq == lent[i - 1].header->topic_seq + 1 + lent[i].missed);
    }
    MUST(scanhub_hub_is_running(handle) == 1);
    MUST(scanhub_take(handle, &fifth) == SCANHUB_REFUSED_ARGUMENT);
    SAYS("four samples");
    copy = lent[1];
    MUST(scanhub_release(&lent[1]) == 0 && lent[1].payload == NULL);
    MUST(scanhub_release(&lent[1]) == 0);
    MUST(scanhub_release(&copy) == SCANHUB_REFUSED_ARGUMENT);
    SAYS("not lent");
    MUST(scanhub_release(NULL) == SCANHUB_REFUSED_ARGUMENT);
    MUST(scanhub_wait(handle, PATIENCE_MS) == 1 && scanhub_wait(handle, PATIENCE_MS) == 1);
    MUST(scanhub_take(handle, &fifth) == 1);
    copy = fifth;
    MUST(scanhub_close(handle) == 0);
    MUST(scanhub_release(&copy) == SCANHUB_REFUSED_ARGUMENT);
}

/* The memory to which the verdict of a robot points stays valid until the program releases the verdict. */
static void robots(const char *sensor)
{
    struct scanhub_attachment *handle;
    struct scanhub_sample lent[4], copy;
    MUST(scanhub_open_robot(&handle, NULL, sensor, SCANHUB_WAIT_DOORBELL) == 0);
    for (int i = 0; i < 4; i++)
        MUST(scanhub_wait(handle, PATIENCE_MS) == 1 && scanhub_take(handle, &lent[i]) == 1);
    for (int i = 0; i < 4; i++) {
        const struct scanhub_robot *robot = lent[i].payload;
        MUST(robot->count == 1 && strcmp(robot->sensors[0].name, sensor) == 0 && robot->worst == robot->sensors[0].name);
        MUST(robot->verdict == robot->sensors[0].verdict && robot->nearest_mm == robot->sensors[0].nearest_mm);
    }
    copy = lent[2];
    MUST(scanhub_release(&lent[2]) == 0 && scanhub_release(&copy) == SCANHUB_REFUSED_ARGUMENT);
    MUST(scanhub_close(handle) == 0);
}

static volatile sig_atomic_t alarms;

static void on_alarm(int signal)
{
    (void)signal;
    alarms++;
}

static void signals(void)
{
    const int ways[] = {SCANHUB_WAIT_DOORBELL, SCANHUB_WAIT_EVENT, SCANHUB_WAIT_SPIN};
    const struct itimerval often = {{0, 5000}, {0, 5000}}, never = {{0, 0}, {0, 0}};
    struct sigaction action;
    memset(&action, 0, sizeof action);
    action.sa_handler = on_alarm;
    MUST(sigaction(SIGALRM, &action, NULL) == 0 && setitimer(ITIMER_REAL, &often, NULL) == 0);
    for (int i = 0; i < 3; i++) {
        struct scanhub_attachment *handle = open_scans("nobody", ways[i]);
        const sig_atomic_t before = alarms;
        MUST(scanhub_wait(handle, 200) == 0);
        MUST(alarms > before);
        MUST(scanhub_close(handle) == 0);
    }
    MUST(setitimer(ITIMER_REAL, &never, NULL) == 0);
}

int main(int argc, char **argv)
{
    const char *sensor = argc > 1 ? argv[1] : "front";
    names(sensor);
    names_that_exist();
    handles(sensor);
    threads(sensor);
    children(sensor);
    polls(sensor);
    samples(sensor);
    robots(sensor);
    publications(sensor);
    signals();
    /* Leave an attachment open with a sample. Both are released when the process exits. */
    struct scanhub_attachment *left = open_scans(sensor, SCANHUB_WAIT_EVENT);
    struct scanhub_sample sample;
    MUST(scanhub_wait(left, PATIENCE_MS) == 1 && scanhub_take(left, &sample) == 1);
    puts("all refused");
    return EXIT_SUCCESS;
}
