// Follows scans with the functions of attach.hpp that need C++17 and C++20: modern SENSOR. Prints one line per scan.
#include <scanhub/attach.hpp>

#include <cstdio>
#include <cstdlib>

using std::chrono::milliseconds;

int main(int argc, char **argv)
{
    scanhub::Attachment none("nowhere", SCANHUB_TOPIC_SCAN);
    if (none.try_next() || none.next_within(milliseconds(5)) || none.next_within(milliseconds(-5)))
        return 1;
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
