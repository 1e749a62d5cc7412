// Whether a sensor sees something too near, said when it changes, until stdin ends: stop [SENSOR]. Waits for both with one
// poll, as a program does that has other things to wait for.
#include <scanhub/attach.hpp>

#include <cerrno>
#include <cstdio>
#include <poll.h>
#include <unistd.h>

static void say(const scanhub_zones_v1 &zones, bool stale)
{
    static const char *const names[] = {"clear", "slow", "stop", "unknown"};
    const unsigned verdict = zones.verdict <= SCANHUB_VERDICT_UNKNOWN ? zones.verdict : SCANHUB_VERDICT_UNKNOWN;
    std::printf("%s%s\n", names[verdict], stale ? ", nothing is heard" : "");
    std::fflush(stdout);
}

int main(int argc, char **argv)
try {
    scanhub::Attachment zones(argc > 1 ? argv[1] : "front", SCANHUB_TOPIC_ZONES, SCANHUB_WAIT_EVENT);
    struct pollfd fds[] = {{zones.fd(), POLLIN, 0}, {STDIN_FILENO, POLLIN, 0}};
    int last = -1;
    for (;;) {
        if (poll(fds, 2, -1) < 0 && errno != EINTR)
            return 1;
        // Take all that there is: only then does poll sleep again.
        while (scanhub::Sample sample = zones.take()) {
            const scanhub_zones_v1 &now = sample.as<scanhub_zones_v1>();
            if (now.verdict != last)
                say(now, sample->stale == 1);
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
