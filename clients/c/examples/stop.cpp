// Prints whether the robot may go, at every change, until stdin ends: stop [SENSOR]... One poll waits for samples and
// stdin, as in a program that also waits for other descriptors.
#include <scanhub/attach.hpp>

#include <cerrno>
#include <cstdio>
#include <poll.h>
#include <string>
#include <unistd.h>

static void say(const scanhub_robot &now)
{
    static const char *const names[] = {"clear", "slow", "stop", "unknown"};
    const unsigned verdict = now.verdict <= SCANHUB_VERDICT_UNKNOWN ? now.verdict : SCANHUB_VERDICT_UNKNOWN;
    std::printf("%s, %s\n", names[verdict], now.worst != nullptr ? now.worst : "no sensor");
    std::fflush(stdout);
}

int main(int argc, char **argv)
try {
    std::string sensors;
    for (int i = 1; i < argc; i++)
        sensors += std::string(argv[i]) + " ";
    scanhub::Attachment robot = scanhub::Attachment::robot(sensors.c_str(), SCANHUB_WAIT_EVENT);
    struct pollfd fds[] = {{robot.fd(), POLLIN, 0}, {STDIN_FILENO, POLLIN, 0}};
    int last = -1;
    for (;;) {
        if (poll(fds, 2, -1) < 0 && errno != EINTR)
            return 1;
        // Take all samples, because the descriptor stays readable until all are taken.
        while (scanhub::Sample sample = robot.take()) {
            const scanhub_robot &now = sample.as<scanhub_robot>();
            if (now.verdict != last)
                say(now);
            last = now.verdict;
        }
        char typed[256];
        if (fds[1].revents != 0 && read(STDIN_FILENO, typed, sizeof typed) <= 0)
            return 0;
    }
} catch (const std::exception &refused) {
    std::fprintf(stderr, "stop: %s\n", refused.what());
    return 1;
}
