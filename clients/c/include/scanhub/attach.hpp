/*
 * The same for C++11 and later: what scanhub_open opens and scanhub_take lends is given back at the end of its scope, and a
 * refusal is an exception. <scanhub/attach.h> has the words.
 *
 *     scanhub::Attachment scans("front", SCANHUB_TOPIC_SCAN);
 *     while (scanhub::Sample sample = scans.next())
 *         use(scanhub_range_m(&*sample, 180), sample.as<scanhub_scan_v2>().collapsed);
 */
#ifndef SCANHUB_ATTACH_HPP
#define SCANHUB_ATTACH_HPP

#include <scanhub/attach.h>

#include <stdexcept>
#include <utility>

namespace scanhub {

/* A call that was refused: what() says why and what to do. */
class Refused : public std::runtime_error {
public:
    explicit Refused(int number) : std::runtime_error(scanhub_error()), number_(number) {}
    /* One of SCANHUB_REFUSED_.. . */
    int number() const { return number_; }

private:
    int number_;
};

inline int check(int answer)
{
    if (answer < 0)
        throw Refused(answer);
    return answer;
}

/* The topic that a payload belongs to; 0 is a robot's verdict. */
template <typename Payload> struct TopicOf;
template <> struct TopicOf<scanhub_scan_v2> { enum { number = SCANHUB_TOPIC_SCAN }; };
template <> struct TopicOf<scanhub_marks_v2> { enum { number = SCANHUB_TOPIC_MARKS }; };
template <> struct TopicOf<scanhub_zones_v2> { enum { number = SCANHUB_TOPIC_ZONES }; };
template <> struct TopicOf<scanhub_foreground_v2> { enum { number = SCANHUB_TOPIC_FOREGROUND }; };
template <> struct TopicOf<scanhub_background_v2> { enum { number = SCANHUB_TOPIC_BACKGROUND }; };
template <> struct TopicOf<scanhub_status_v2> { enum { number = SCANHUB_TOPIC_STATUS }; };
template <> struct TopicOf<scanhub_lines_v2> { enum { number = SCANHUB_TOPIC_LINES }; };
template <> struct TopicOf<scanhub_motion_v2> { enum { number = SCANHUB_TOPIC_MOTION }; };
template <> struct TopicOf<scanhub_early_v2> { enum { number = SCANHUB_TOPIC_EARLY }; };
template <> struct TopicOf<scanhub_tracks_v2> { enum { number = SCANHUB_TOPIC_TRACKS }; };
template <> struct TopicOf<scanhub_event_v2> { enum { number = SCANHUB_TOPIC_EVENTS }; };
template <> struct TopicOf<scanhub_tilt_v2> { enum { number = SCANHUB_TOPIC_TILT }; };
template <> struct TopicOf<scanhub_cloud_v2> { enum { number = SCANHUB_TOPIC_CLOUD }; };
template <> struct TopicOf<scanhub_obstacles_v2> { enum { number = SCANHUB_TOPIC_OBSTACLES }; };
template <> struct TopicOf<scanhub_robot> { enum { number = 0 }; };

/* A sample, or none; given back when it goes out of scope. */
class Sample {
public:
    Sample() : sample_(), topic_() {}
    Sample(Sample &&other) noexcept : sample_(other.sample_), topic_(other.topic_) { other.sample_ = scanhub_sample(); }
    Sample &operator=(Sample &&other) noexcept
    {
        std::swap(sample_, other.sample_);
        std::swap(topic_, other.topic_);
        return *this;
    }
    Sample(const Sample &) = delete;
    Sample &operator=(const Sample &) = delete;
    ~Sample() { scanhub_release(&sample_); }

    explicit operator bool() const { return sample_.payload != nullptr; }
    /* Its fields: header, length, missed, restarted, stale. */
    const scanhub_sample *operator->() const { return &sample_; }
    const scanhub_sample &operator*() const { return sample_; }
    /* The payload, or what it begins with, of the type that belongs to the topic. */
    template <typename Payload> const Payload &as() const
    {
        if (sample_.length < sizeof(Payload) || topic_ != TopicOf<Payload>::number)
            throw std::logic_error("the sample is none, or of another topic");
        return *static_cast<const Payload *>(sample_.payload);
    }

private:
    friend class Attachment;
    scanhub_sample sample_;
    int topic_;
};

/* A topic that is followed, in the thread that made it. */
class Attachment {
public:
    explicit Attachment(const char *sensor, int topic, int wait = SCANHUB_WAIT_DOORBELL, const char *domain = nullptr)
        : handle_(nullptr), topic_(topic)
    {
        check(scanhub_open(&handle_, domain, sensor, topic, wait));
    }
    /* The verdict over several sensors, as scanhub_open_robot: its samples are scanhub_robot. */
    static Attachment robot(const char *sensors = nullptr, int wait = SCANHUB_WAIT_DOORBELL, const char *domain = nullptr)
    {
        Attachment all;
        check(scanhub_open_robot(&all.handle_, domain, sensors, wait));
        return all;
    }
    /* The same with early warnings, as scanhub_open_robot_early. */
    static Attachment robot_early(
        const char *sensors = nullptr, int wait = SCANHUB_WAIT_DOORBELL, const char *domain = nullptr)
    {
        Attachment all;
        check(scanhub_open_robot_early(&all.handle_, domain, sensors, wait));
        return all;
    }
    Attachment(Attachment &&other) noexcept : handle_(other.handle_), topic_(other.topic_) { other.handle_ = nullptr; }
    Attachment &operator=(Attachment &&other) noexcept
    {
        std::swap(handle_, other.handle_);
        std::swap(topic_, other.topic_);
        return *this;
    }
    Attachment(const Attachment &) = delete;
    Attachment &operator=(const Attachment &) = delete;
    /* Samples that are still lent end with it. */
    ~Attachment() { scanhub_close(handle_); }

    /* The next sample if there is one; never waits. */
    Sample take()
    {
        Sample sample;
        sample.topic_ = topic_;
        check(scanhub_take(handle_, &sample.sample_));
        return sample;
    }
    /* Waits for the next sample; none if `timeout_ms` are over (negative: never). */
    Sample next(int timeout_ms = -1)
    {
        return check(scanhub_wait(handle_, timeout_ms)) == 1 ? take() : Sample();
    }
    /* As scanhub_fd. */
    int fd() { return check(scanhub_fd(handle_)); }
    /* As scanhub_hub_lives. */
    bool hub_lives() { return check(scanhub_hub_lives(handle_)) == 1; }

private:
    Attachment() : handle_(nullptr), topic_(0) {}
    scanhub_attachment *handle_;
    int topic_;
};

/* The angles of a mount that this thread publishes, as scanhub_publish_tilt. */
class TiltPublication {
public:
    explicit TiltPublication(const char *name, const char *domain = nullptr) : publication_(nullptr)
    {
        check(scanhub_publish_tilt(&publication_, domain, name));
    }
    TiltPublication(TiltPublication &&other) noexcept : publication_(other.publication_) { other.publication_ = nullptr; }
    TiltPublication &operator=(TiltPublication &&other) noexcept
    {
        std::swap(publication_, other.publication_);
        return *this;
    }
    TiltPublication(const TiltPublication &) = delete;
    TiltPublication &operator=(const TiltPublication &) = delete;
    ~TiltPublication() { scanhub_unpublish(publication_); }

    /* As scanhub_send_tilt. */
    void send(double angle_rad, double rate_rad_s = NAN, uint64_t stamp_ns = 0)
    {
        check(scanhub_send_tilt(publication_, stamp_ns, angle_rad, rate_rad_s));
    }

private:
    scanhub_publication *publication_;
};

} // namespace scanhub

#endif
