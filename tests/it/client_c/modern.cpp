// Subscribes to scans with the functions of attach.hpp that need C++17 and C++20: modern SENSOR. Prints one line per scan.
#include <scanhub/attach.hpp>

#include <cstdio>
#include <cstdlib>

using std::chrono::milliseconds;

int main(int argc, char **argv)
{
    scanhub::Attachment none("nowhere", SCANHUB_TOPIC_SCAN);
    if (none.try_next() || none.next_within(milliseconds(5)) || none.next_within(milliseconds(-5)))
        return 1;
    const scanhub::Silence silence = none.why_silent();
    const bool is_unknown = silence.reason == SCANHUB_SILENCE_UNKNOWN_SENSOR;
    if (!is_unknown || silence.text.find("the sensors are front") == std::string::npos)
        return 5;
    if (none.silent_for() < milliseconds(5) || none.silent_for() > std::chrono::hours(1))
        return 6;
    const std::vector<std::string> topics = scanhub::topics();
    if (scanhub::sensors() != std::vector<std::string>{"front"} || topics.size() < 2 || topics[0].find("front/") != 0)
        return 7;
    if (!scanhub::topics("no-hub-is-here").empty())
        return 8;
    scanhub::Attachment scans(argc > 1 ? argv[1] : "front", SCANHUB_TOPIC_SCAN);
    for (int left = 5; left > 0; left--) {
        const std::optional<scanhub::Sample> scan = scans.next_within(std::chrono::hours(10'000));
        if (!scan)
            return 2;
        const std::span<const uint16_t> ranges = scanhub::ranges(*scan);
        if (ranges.size() != scanhub_count(&**scan) || ranges.data() != scanhub_ranges(&**scan))
            return 3;
        try {
            scanhub::segments(*scan);
            return 4;
        } catch (const std::logic_error &) {
        }
        std::printf("%zu\n", ranges.size());
    }
}
