/*
 * The topics of a hub on this machine for programs in C and C++: its samples in shared memory, read where the hub wrote
 * them. C99, or C++11; link with -lscanhub. docs/c.md is the page about it, docs/topics.md has the bytes.
 *
 *     struct scanhub_attachment *scans;
 *     struct scanhub_sample sample;
 *     if (scanhub_open(&scans, NULL, "front", SCANHUB_TOPIC_SCAN, SCANHUB_WAIT_DOORBELL) < 0)
 *         fprintf(stderr, "%s\n", scanhub_error());
 *     while (scanhub_wait(scans, -1) == 1 && scanhub_take(scans, &sample) == 1) {
 *         for (unsigned i = 0; i < scanhub_count(&sample); i++)
 *             use(scanhub_range_m(&sample, i), scanhub_angle(&sample, i));
 *         scanhub_release(&sample);
 *     }
 *     scanhub_close(scans);
 *
 * The hub need not run yet: the library waits for it, and for the next one after it ends or is killed. A program that is too
 * slow misses samples and sees how many; it never slows the hub.
 *
 * A handle belongs to the thread that opened it; other threads open handles of their own. All functions may be called with
 * a handle that was closed, or with NULL: they refuse it. A child after fork() opens its own, and may end as it likes.
 *
 * Functions return 0 or more. A negative number is one of SCANHUB_REFUSED_..; scanhub_error() then has the message and the
 * remedy. Signals are never an error.
 */
#ifndef SCANHUB_ATTACH_H
#define SCANHUB_ATTACH_H

#include <math.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Why a call was refused. */
#define SCANHUB_REFUSED_ARGUMENT (-1)      /* NULL, an unknown handle or number, a fifth sample */
#define SCANHUB_REFUSED_CONFIGURATION (-2) /* an invalid name, a descriptor without SCANHUB_WAIT_EVENT */
#define SCANHUB_REFUSED_SHORT (-3)         /* shared memory, descriptors or places for consumers are short: try later */
#define SCANHUB_REFUSED_FAILED (-4)        /* another user's domain, another version's topic, a taken name, or another failure */
#define SCANHUB_REFUSED_BUG (-5)           /* in this library; close the handle */

/* What the hub publishes for each sensor, and what a payload is, or begins with. */
#define SCANHUB_TOPIC_TELEGRAM 1   /* length bytes: of an LMS STX to CRC, of other families whole packets */
#define SCANHUB_TOPIC_SCAN 2       /* struct scanhub_scan_v2 */
#define SCANHUB_TOPIC_MARKS 3      /* struct scanhub_marks_v2 */
#define SCANHUB_TOPIC_ZONES 4      /* struct scanhub_zones_v2 */
#define SCANHUB_TOPIC_FOREGROUND 5 /* struct scanhub_foreground_v2 */
#define SCANHUB_TOPIC_BACKGROUND 6 /* struct scanhub_background_v2 */
#define SCANHUB_TOPIC_STATUS 7     /* struct scanhub_status_v2 */
#define SCANHUB_TOPIC_LINES 8      /* struct scanhub_lines_v2 */
#define SCANHUB_TOPIC_MOTION 9     /* struct scanhub_motion_v2 */
#define SCANHUB_TOPIC_EARLY 10     /* struct scanhub_early_v2 */
#define SCANHUB_TOPIC_TRACKS 11    /* struct scanhub_tracks_v2 */
#define SCANHUB_TOPIC_EVENTS 12    /* struct scanhub_event_v2 */
#define SCANHUB_TOPIC_TILT 13      /* struct scanhub_tilt_v2 */
#define SCANHUB_TOPIC_CLOUD 14     /* struct scanhub_cloud_v2 */
#define SCANHUB_TOPIC_OBSTACLES 15 /* struct scanhub_obstacles_v2 */

/* How scanhub_wait waits. */
#define SCANHUB_WAIT_DOORBELL 0 /* at a word in the hub's memory, at which one call wakes all: what to take if in doubt */
#define SCANHUB_WAIT_EVENT 1    /* at a descriptor, which poll and epoll can wait at too: scanhub_fd */
#define SCANHUB_WAIT_SPIN 2     /* not asleep: takes a whole processor for the shortest latency there is */

/* A topic that is followed. */
struct scanhub_attachment;

/* A topic that this program publishes. */
struct scanhub_publication;

/* Of every sample, 64 bytes. Stamps are nanoseconds of CLOCK_MONOTONIC. */
struct scanhub_header_v2 {
    uint64_t seq;            /* number of the telegram, per sensor and hub life; the same in all that was made of it */
    uint64_t topic_seq;      /* number of the sample in its topic */
    uint64_t stamp_first_ns; /* of the telegram's first byte */
    uint64_t stamp_last_ns;  /* of its last byte */
    uint64_t wall_ns;        /* wall clock of the first byte, ns since 1970 */
    uint64_t boot;           /* random per start of the hub */
    uint8_t sensor;          /* position of the link in the hub's configuration */
    uint8_t quality;         /* 0 clean, 1 suspect */
    uint8_t flags;           /* 2 simulated, 4 replayed, 8 stamp estimated, 32 of another machine */
    uint8_t family;          /* of the scanner: SCANHUB_FAMILY_... */
    uint32_t period_us;      /* nominal time between two scans, 0 unknown */
    uint32_t hub_pid;
    uint8_t reasons;         /* to suspect it: 1 line error, 2 neighbour, 4 slow, 8 forbidden bits, 16 header inside */
    uint8_t hub_time[3];     /* from the last byte until it was sent, in 256 ns, the low byte first */
};

/* Families of scanners. */
#define SCANHUB_FAMILY_LMS 0
#define SCANHUB_FAMILY_LD 1
#define SCANHUB_FAMILY_RPLIDAR 2

/* The arrays of a scan, beside its ranges. */
#define SCANHUB_SCAN_UPPER 1  /* a byte: intensities, or of some modes of an LMS field bits */
#define SCANHUB_SCAN_WIDE 2   /* two bytes: intensities */
#define SCANHUB_SCAN_ANGLES 4 /* exact angles */

/*
 * A scan begins with this; behind it are exact angles (float), ranges (uint16_t), wide intensities (uint16_t), upper bits
 * (uint8_t), of each array that there is one value for every beam. Read them by the functions below. Angles are in radians: 0
 * is the sensor's own ahead, counter-clockwise positive seen from above.
 */
struct scanhub_scan_v2 {
    double first_angle;     /* of beam 0 */
    double step;            /* from one beam to the next; negative for a scanner that turns clockwise */
    float spacing;          /* between two points that the sensor itself measures */
    uint32_t beam_time_ns;  /* from one beam to the next */
    int32_t first_beam_ns;  /* when beam 0 was measured, after the sample's stamp: mostly before it */
    uint32_t unit_um;       /* micrometres per device unit */
    uint16_t count;         /* beams, in the order of their measuring, at most 8192 */
    uint16_t valid_to;      /* the greatest value that is a range; all above are codes */
    uint16_t no_return;     /* the code of a beam that nothing returned to */
    uint16_t beyond;        /* the code of an echo from beyond the range limit */
    uint16_t collapsed;     /* points dropped because another has the same beam */
    uint8_t family;         /* SCANHUB_FAMILY_.. */
    uint8_t flags;          /* 1: packets of the turn are missing */
    uint8_t contents;       /* SCANHUB_SCAN_.. */
    uint8_t intensity_bits; /* of an intensity; 0: there are none */
    uint8_t turns;          /* beam i was measured in turn i modulo this; 0 is 1 */
    uint8_t reserved;
    uint32_t turn_ns;       /* time of one of several turns */
    uint8_t reserved2[12];
};

struct scanhub_mark_v2 {
    int32_t angle_mdeg;
    uint32_t range_dmm; /* 1/10 mm */
    uint16_t weight;    /* sum of intensities */
    uint8_t peak;       /* greatest intensity */
    uint8_t edge;       /* 1: touches the first or last beam */
    uint16_t first_beam;
    uint16_t last_beam;
};

struct scanhub_marks_v2 {
    uint8_t count; /* at most 64 */
    uint8_t flags; /* 1 there were more, 2 unavailable: the measuring mode has no reflector bits, or 4: marks.level is not set */
    uint16_t reserved;
    struct scanhub_mark_v2 mark_array[64];
};

struct scanhub_line_v2 {
    float x1_m; /* where its first beam meets it: ahead of the robot's centre */
    float y1_m; /* to the left of it */
    float x2_m; /* where its last beam meets it */
    float y2_m;
    float r_m; /* x cos alpha + y sin alpha = r */
    float alpha_rad;
    float sd_r_m; /* standard deviations */
    float sd_alpha_rad;
    uint16_t first; /* beam */
    uint16_t last;
    uint16_t points; /* its beams that have a range */
    uint16_t reserved;
};

struct scanhub_corner_v2 {
    float x_m;
    float y_m;
    uint16_t first_line; /* the lines that meet here */
    uint16_t second_line;
};

struct scanhub_lines_v2 {
    uint8_t count;   /* lines, at most 64 */
    uint8_t corners; /* at most 64 */
    uint8_t flags;   /* 1 there are more than are allowed */
    uint8_t reserved;
    uint16_t readings; /* beams of the scan that have a range */
    uint16_t on_lines; /* of them those that end on a line */
    float noise_m;     /* standard deviation of the ranges in this scan */
    struct scanhub_line_v2 line_array[64];
    struct scanhub_corner_v2 corner_array[64];
};

/* How a step was found. */
#define SCANHUB_METHOD_FIRST 0   /* it is the first scan: there is no step */
#define SCANHUB_METHOD_REFUSED 1 /* neither step nor place are known, and so with every number that is not here */
#define SCANHUB_METHOD_BEAMS 2
#define SCANHUB_METHOD_POINTS 3
#define SCANHUB_METHOD_LINES 4
#define SCANHUB_METHOD_BOTH 5

struct scanhub_motion_v2 {
    double x_m; /* the sum of all steps: ahead of where the robot was at the start */
    double y_m;
    double yaw_rad;
    float dx_m; /* the step since the scan before: ahead */
    float dy_m;
    float dyaw_rad;
    float covariance[9]; /* of the step, row by row */
    float overlap;       /* share of the readings that lie on the scan before */
    uint8_t method;
    uint8_t flags;   /* 1 the surroundings leave a direction open; 2 the sum contains a step with an open direction */
    uint16_t breaks; /* steps that were refused since the start */
    float pose_covariance[9]; /* of the sum, as `covariance`; 0 if it is not valid or the sender is older */
    uint32_t reserved;
};

struct scanhub_zone_v2 {
    uint16_t radius_mm;
    uint16_t beams;   /* that met something inside */
    uint8_t violated; /* 1: enough of them, in enough scans */
    uint8_t reserved[3];
};

/* Verdicts. */
#define SCANHUB_VERDICT_CLEAR 0
#define SCANHUB_VERDICT_SLOW 1
#define SCANHUB_VERDICT_STOP 2
#define SCANHUB_VERDICT_UNKNOWN 3 /* to be taken as stop, and so is every other number */

struct scanhub_zones_v2 {
    uint8_t verdict;
    uint8_t count;         /* circles, at most 8 */
    uint16_t nearest_beam; /* 65535: none */
    uint32_t nearest_mm;   /* from the robot's centre */
    uint16_t invalid_beams;
    uint8_t flags;         /* 1: fewer scans were seen than a violation takes */
    uint8_t reserved;
    struct scanhub_zone_v2 zone_array[8]; /* the largest first */
};

/* A warning by a scan that was not complete, a telegram or a turn. The first zones with its number or a greater one confirm it,
 * or it is withdrawn. */
struct scanhub_early_v2 {
    uint8_t verdict;      /* SCANHUB_VERDICT_SLOW or SCANHUB_VERDICT_STOP */
    uint8_t flags;        /* 1 withdrawn: what was said under this number does not hold */
    uint16_t beam;        /* of the nearest point so far */
    uint32_t distance_mm; /* of that, from the robot's centre */
    uint16_t bytes_seen;  /* of the telegram; 0 of a turn */
    uint16_t beams_seen;  /* of the scan */
};

/* How well a person is known. */
#define SCANHUB_TRACK_TENTATIVE 0     /* perhaps a person, and so is every number that is not here */
#define SCANHUB_TRACK_CONFIRMED 1     /* a person who is seen */
#define SCANHUB_TRACK_HIDDEN 2        /* a person who is not seen, where nobody could be seen either */
#define SCANHUB_TRACK_BETWEEN_ROOMS 3 /* a person on a way that no sensor sees */

struct scanhub_track_v2 {
    uint64_t id; /* nobody else ever gets it */
    float x_m;   /* the middle between his legs, in the map of the site */
    float y_m;
    float vx_m_s;
    float vy_m_s;
    float covariance[3]; /* of the place, m2: xx, xy, yy */
    float score;         /* how sure it is that this is a person, 0 to 1 */
    uint32_t age_ms;     /* since he was first seen */
    uint32_t sensors;    /* bit i: sensor_array[i] sees him */
    char room_text[24];  /* UTF-8, 0 behind it; 24 bytes have none */
    uint8_t state;       /* SCANHUB_TRACK_.. */
    uint8_t reserved[7];
};

struct scanhub_track_sensor_v2 {
    float x_m; /* where it sits in the map */
    float y_m;
    float yaw_rad;       /* where it looks, counter-clockwise from x */
    uint8_t upside_down; /* 1: it hangs so */
    uint8_t reserved[3];
    char name_text[56]; /* 0 behind it */
};

/* People at one instant, which is wall_ns of the header. */
struct scanhub_tracks_v2 {
    uint8_t count;   /* people, at most 64 */
    uint8_t sensors; /* of the site, at most 32 */
    uint8_t reserved[6];
    struct scanhub_track_v2 track_array[64];
    struct scanhub_track_sensor_v2 sensor_array[32];
};

/* What happened to a person. */
#define SCANHUB_EVENT_APPEARED 0
#define SCANHUB_EVENT_LEFT 1
#define SCANHUB_EVENT_DOOR 2

struct scanhub_event_v2 {
    uint64_t id;
    uint8_t kind; /* SCANHUB_EVENT_.. */
    uint8_t reserved[7];
    char room_text[24]; /* where he then is; texts are UTF-8 with 0 behind them, 24 bytes have none */
    char door_text[24]; /* of SCANHUB_EVENT_DOOR, as are the next two */
    char from_text[24];
    char to_text[24];
};

/* The angle of a mount at the stamps of the header. */
struct scanhub_tilt_v2 {
    double angle_rad;  /* right-handed around the mount's axis */
    double rate_rad_s; /* how fast it grows; nan: not known */
};

/* What is made of a sweep, the way of a mount from turn to turn. */
#define SCANHUB_SWEEP_FIRST 1    /* of clouds: the first sample of its sweep */
#define SCANHUB_SWEEP_LAST 2     /* of clouds: the last one */
#define SCANHUB_SWEEP_COMPLETE 4 /* it went from one turn to the next, and no angle was missing */
#define SCANHUB_SWEEP_DOUBTED 8  /* its angles contradict the background: nothing is known of what stands there */

/* A cloud, the points of one scan, begins with this; behind it are the points: see scanhub_cloud_points. */
struct scanhub_cloud_v2 {
    uint32_t sweep;      /* its number, from 0 */
    uint32_t generation; /* of the background: one more each time that it was forgotten */
    uint16_t count;      /* points */
    uint8_t flags;       /* SCANHUB_SWEEP_.. */
    uint8_t reserved[5];
};

/* What a point is beside the background. */
#define SCANHUB_CLASS_UNKNOWN 0    /* not known yet, and so is every number that is not here */
#define SCANHUB_CLASS_BACKGROUND 1 /* where something stands always */
#define SCANHUB_CLASS_FOREGROUND 2 /* nearer than that */
#define SCANHUB_CLASS_BEHIND 3     /* farther away */

struct scanhub_cloud_point_v2 {
    float at[3];         /* metres ahead, to the left, above the floor */
    uint16_t beam;       /* its number in the scan */
    uint8_t point_class; /* SCANHUB_CLASS_.. */
    uint8_t reserved;
};

/* Something that stands there; all in the robot's frame: metres ahead, to the left, above the floor. */
#define SCANHUB_OBSTACLE_FOREGROUND 1 /* has points before the background */
#define SCANHUB_OBSTACLE_NEAR 2       /* has points in the space that is to be free */

struct scanhub_obstacle_v2 {
    float middle[3];  /* mean of its points */
    float low[3];     /* their least coordinates */
    float high[3];    /* their greatest */
    float distance_m; /* of its nearest point from the robot's centre, over ground */
    uint32_t points;
    uint8_t flags;    /* SCANHUB_OBSTACLE_.. */
    uint8_t reserved[3];
};

/* What one sweep has found. */
struct scanhub_obstacles_v2 {
    uint32_t sweep;      /* as in a cloud */
    uint32_t generation; /* as in a cloud */
    uint32_t left_out;   /* obstacles that did not fit */
    uint8_t count;       /* at most 64 */
    uint8_t flags;       /* SCANHUB_SWEEP_.. */
    uint8_t reserved[2];
    struct scanhub_obstacle_v2 obstacle_array[64]; /* the nearest first */
};

struct scanhub_segment_v2 {
    uint16_t first; /* beam */
    uint16_t last;
    uint16_t nearest; /* device units */
    uint16_t width;
    int32_t x_mm; /* mean of its points in the robot's frame */
    int32_t y_mm;
};

/* A foreground begins with this; behind it are 64 places for segments, a bit for every beam, and ranges: see below. */
struct scanhub_foreground_v2 {
    uint32_t generation; /* of the background that the scan was compared with */
    uint32_t unit_um;
    uint16_t count;      /* beams of the scan */
    uint16_t beams;      /* of them in the foreground */
    uint16_t segments;   /* at most 64 */
    uint16_t left_out;   /* segments that did not fit */
    uint64_t supported;  /* a bit for each segment: see scanhub_has_support */
};

/* A background begins with this; behind it is a range for every beam: see scanhub_background_ranges. */
struct scanhub_background_v2 {
    double first_angle; /* as of a scan */
    double step;        /* 0 before the first scan */
    uint32_t generation;
    uint32_t unit_um;
    uint16_t taught; /* beams whose background is known */
    uint16_t count;  /* beams of the model, 0 before the first scan */
    uint8_t flags;   /* 1 frozen */
    uint8_t reserved[3];
};

/* Where the counters of a status stand. */
enum scanhub_counter {
    SCANHUB_COUNTER_BYTES_READ,
    SCANHUB_COUNTER_BYTES_IN_TELEGRAMS,
    SCANHUB_COUNTER_BYTES_ACKNOWLEDGE,
    SCANHUB_COUNTER_BYTES_DISCARDED,
    SCANHUB_COUNTER_BYTES_BUFFERED,
    SCANHUB_COUNTER_TELEGRAMS,
    SCANHUB_COUNTER_SUSPECT,
    SCANHUB_COUNTER_ABORTED,
    SCANHUB_COUNTER_RESYNCS,
    SCANHUB_COUNTER_RECONNECTS,
    SCANHUB_COUNTER_LOST_IN_RESTART,
    SCANHUB_COUNTER_WAKEUPS,
    SCANHUB_COUNTER_LOAN_FAILED,
    SCANHUB_COUNTER_REJECTED_ADDRESS,
    SCANHUB_COUNTER_REJECTED_LENGTH,
    SCANHUB_COUNTER_REJECTED_COMMAND,
    SCANHUB_COUNTER_REJECTED_COUNT,
    SCANHUB_COUNTER_REJECTED_CRC,
    SCANHUB_COUNTER_REJECTED_VETOED,
    SCANHUB_COUNTER_REJECTED_SUPERSEDED,
    SCANHUB_COUNTER_LINE_ERRORS,
    SCANHUB_COUNTER_BYTES_DAMAGED,
    SCANHUB_COUNTER_DAMAGED_PPM, /* of the last 10 s, in millionths */
    SCANHUB_COUNTER_DUE_ON_LINE, /* 0: what was lost on the line is not known */
    SCANHUB_COUNTER_LOST_ON_LINE,
    SCANHUB_COUNTER_LOST_PPM, /* of the last 10 s, in millionths */
    SCANHUB_COUNTER_SCANNER_RESTARTS /* that the hub did not request */
};

struct scanhub_pose_v2 {
    double x_m; /* ahead of the robot's centre */
    double y_m; /* to the left of it */
    double yaw_rad;
    uint8_t upside_down;
    uint8_t reserved[7]; /* of a status, the first one is 1 if marks.level is set */
};

/* States. */
#define SCANHUB_STATE_ABSENT 0
#define SCANHUB_STATE_PROBING 1
#define SCANHUB_STATE_SWITCHING 2
#define SCANHUB_STATE_STARTING 3
#define SCANHUB_STATE_STREAMING 4
#define SCANHUB_STATE_SILENT 5
#define SCANHUB_STATE_PAUSED 6

/* Texts are UTF-8 and end with 0 only where they do not fill their array: print them by "%.128s". */
struct scanhub_status_v2 {
    uint8_t state;
    uint8_t mode;    /* measuring mode, 255 unknown */
    uint8_t unit_mm; /* 0 unknown */
    uint8_t family;  /* SCANHUB_FAMILY_.. */
    uint32_t baud;     /* 0 unknown */
    uint64_t since_ns; /* stamp of the state's beginning */
    uint32_t rate_mhz; /* scans per second in 1/1000 */
    uint16_t angle_deg;
    uint16_t resolution_cdeg;
    char type_text[24];
    char port_text[128];
    char last_error_text[160];
    uint64_t counters[28]; /* by enum scanhub_counter */
    struct scanhub_pose_v2 pose;
};

/* No beam has a valid reading. */
#define SCANHUB_NOTHING_MM UINT32_MAX

/* A sensor of a robot. */
struct scanhub_robot_sensor {
    const char *name;
    uint8_t verdict;     /* unknown where it was not heard lately, or never */
    uint32_t nearest_mm; /* from the robot's centre, of what it sees nearest; or SCANHUB_NOTHING_MM */
};

/* What is known of a robot: the payload of scanhub_open_robot. All of it is lent with the sample. */
struct scanhub_robot {
    uint8_t verdict;     /* the worst of its sensors: stop, unknown, slow, clear; unknown as long as there are none */
    uint32_t nearest_mm; /* of all sensors; or SCANHUB_NOTHING_MM */
    const char *worst;   /* the first sensor with this verdict; NULL: there are none */
    const char *nearest; /* the sensor that sees what is nearest; NULL: nobody does */
    size_t count;        /* of sensors */
    const struct scanhub_robot_sensor *sensors;
};

/* A sample that is lent: scanhub_take fills it, scanhub_release empties it. */
struct scanhub_sample {
    const struct scanhub_header_v2 *header; /* NULL: no hub sent it, see stale; or a robot's verdict */
    const void *payload;                    /* where the hub wrote it, for reading */
    size_t length;                          /* its bytes, as far as they are used */
    uint64_t missed;                        /* samples that were sent before it and not received */
    int restarted;                          /* 1: the hub restarted, seq and topic_seq start again */
    int stale;                              /* 1: zones that are unknown because no recent data arrived */
    struct scanhub_attachment *of;                     /* the library's */
    uint64_t number;                        /* the library's */
};

/*
 * Starts to follow a topic of `sensor` ("front", "robot1.front") in `domain` (NULL: the one that SCANHUB_DOMAIN names). It
 * does not wait for a hub. Returns 0; *handle is NULL after a refusal.
 */
int scanhub_open(struct scanhub_attachment **handle, const char *domain, const char *sensor, int topic, int wait);

/*
 * Starts to follow the verdict over the zones of `sensors`: names with blanks between them, "front rear". NULL: all sensors of
 * the hub; in a domain without a hub the sensors of other machines that are published there. scanhub_take then lends a struct
 * scanhub_robot (a copy without header): once every sensor has a verdict, whenever one gets a new verdict, and when one is
 * silent for too long, whose verdict then becomes unknown by itself. Everything else is as with scanhub_open.
 */
int scanhub_open_robot(struct scanhub_attachment **handle, const char *domain, const char *sensors, int wait);

/*
 * The same, with early warnings (docs/early.md): the verdict becomes worse before a scan (a telegram or a turn) is complete,
 * and goes back if the warning is withdrawn.
 */
int scanhub_open_robot_early(struct scanhub_attachment **handle, const char *domain, const char *sensors, int wait);

/*
 * A descriptor that is readable while there may be a sample, for poll, select and epoll: never read, written or closed. It
 * stays the same until scanhub_close, also over restarts of the hub. It is readable until scanhub_take has returned 0: take
 * all, then poll. A readable descriptor does not promise a sample: it also becomes readable once a second, ten times a second
 * while there is no hub, and when other topics of the sensor have a sample. Only with SCANHUB_WAIT_EVENT.
 */
int scanhub_fd(struct scanhub_attachment *handle);

/*
 * Sleeps until there is a sample to take: 1; or until `timeout_ms` are over: 0. Negative: waits without limit. A signal whose
 * handler returns does not end the wait: choose a timeout within which your program must see the handler's flag.
 */
int scanhub_wait(struct scanhub_attachment *handle, int timeout_ms);

/*
 * Lends the next sample: 1; or there is none: 0, and *sample is empty. Never waits. Four samples can be lent at a time; what
 * a sample points to lives until it is released.
 *
 * Of zones it is the latest one, as a copy. When that becomes too old, because sensor, hub or machine stopped, there is one
 * more sample, without header, whose verdict is unknown (`stale`). A program that acts on zones needs no clock of its own.
 */
int scanhub_take(struct scanhub_attachment *handle, struct scanhub_sample *sample);

/* Returns a sample and empties it: 0, also if it is empty. A refused sample stays as it is. */
int scanhub_release(struct scanhub_sample *sample);

/* Closes the handle; its lent samples become invalid too: 0, also for NULL. */
int scanhub_close(struct scanhub_attachment *handle);

/* 1 if a hub lives in the domain, 0 if not, as of the last call that found no sample. */
int scanhub_hub_lives(struct scanhub_attachment *handle);

/*
 * Publishes the angles of a mount as the topic tilt of `name` ("mount") in `domain` (NULL: the one that SCANHUB_DOMAIN names),
 * for scanhub tilt and all other subscribers: docs/tilt.md. There need not be a hub. A name with a dot is refused with
 * SCANHUB_REFUSED_CONFIGURATION. One process publishes under it: if another one has it, a program or the hub whose sensor it
 * is, SCANHUB_REFUSED_FAILED, and scanhub_error names that process. Returns 0; *publication is NULL after a refusal.
 */
int scanhub_publish_tilt(struct scanhub_publication **publication, const char *domain, const char *name);

/*
 * Says that the mount was at `angle_rad`, right-handed around its axis, at `stamp_ns` of CLOCK_MONOTONIC (0: now), and how fast
 * the angle grew (NAN: not known). Wakes who follows it, and waits for nobody: 0.
 */
int scanhub_send_tilt(struct scanhub_publication *publication, uint64_t stamp_ns, double angle_rad, double rate_rad_s);

/* Ends it and gives the name free: 0, also for NULL. The end of the thread or of the process does the same. */
int scanhub_unpublish(struct scanhub_publication *publication);

/* The message of this thread's last refused call: a line, and often a second one with the remedy. Valid until the next. */
const char *scanhub_error(void);

/* The version of the library, "0.1.0". */
const char *scanhub_version(void);

/*
 * Samples of SCANHUB_TOPIC_SCAN. Beams are numbered from 0; one that does not exist has no reading.
 */

/* The head of a scan; NULL if the sample is none. */
static inline const struct scanhub_scan_v2 *scanhub_scan_head(const struct scanhub_sample *scan)
{
    const size_t head = sizeof(struct scanhub_scan_v2);
    return scan->length < head ? NULL : (const struct scanhub_scan_v2 *)scan->payload;
}

/* Bytes of a beam in the arrays of `contents`; 8 stands for the ranges. */
static inline size_t scanhub_scan_width(unsigned contents)
{
    return (contents & SCANHUB_SCAN_ANGLES ? 4u : 0u) + (contents & 8u ? 2u : 0u) + (contents & SCANHUB_SCAN_WIDE ? 2u : 0u)
        + (contents & SCANHUB_SCAN_UPPER ? 1u : 0u);
}

/* Beams of a scan: the same number in all scans of a sensor and its settings. */
static inline unsigned scanhub_count(const struct scanhub_sample *scan)
{
    const struct scanhub_scan_v2 *head = scanhub_scan_head(scan);
    if (head == NULL)
        return 0;
    const size_t room = (scan->length - sizeof *head) / scanhub_scan_width(head->contents | 8u);
    return head->count < room ? head->count : (unsigned)room;
}

/* Where the array behind those of `before` begins. */
static inline const void *scanhub_scan_array(const struct scanhub_sample *scan, unsigned before)
{
    const struct scanhub_scan_v2 *head = scanhub_scan_head(scan);
    if (head == NULL)
        return NULL;
    const size_t offset = scanhub_count(scan) * scanhub_scan_width(before & (head->contents | 8u));
    return (const unsigned char *)scan->payload + sizeof *head + offset;
}

/* The ranges in device units, scanhub_count of them, for who reads many: those above `valid_to` are codes, which are no ranges. */
static inline const uint16_t *scanhub_ranges(const struct scanhub_sample *scan)
{
    return (const uint16_t *)scanhub_scan_array(scan, SCANHUB_SCAN_ANGLES);
}

/* The range of beam i in metres; NAN if it has no reading, whatever the reason. */
static inline double scanhub_range_m(const struct scanhub_sample *scan, unsigned i)
{
    if (i >= scanhub_count(scan))
        return NAN;
    const uint16_t range = scanhub_ranges(scan)[i];
    const struct scanhub_scan_v2 *head = scanhub_scan_head(scan);
    return range <= head->valid_to ? (double)range * head->unit_um / 1e6 : NAN;
}

/* The angle of beam i in radians, exact where the sensor says so; NAN for a sample that is none. */
static inline double scanhub_angle(const struct scanhub_sample *scan, unsigned i)
{
    const struct scanhub_scan_v2 *head = scanhub_scan_head(scan);
    if (head == NULL)
        return NAN;
    if (head->contents & SCANHUB_SCAN_ANGLES && i < scanhub_count(scan)) {
        const double exact = (double)((const float *)scanhub_scan_array(scan, 0))[i];
        if (!isnan(exact))
            return exact;
    }
    return head->first_angle + i * head->step;
}

/*
 * Why beam i has no reading: "not_measured", "no_return", "beyond" the range limit, "too_near", "too_bright", "weak",
 * "overflow", "error"; NULL if it has one, or does not exist.
 */
static inline const char *scanhub_code(const struct scanhub_sample *scan, unsigned i)
{
    static const char *const words[] = {"not_measured", "no_return", "beyond", "too_near", "too_bright", "weak", "overflow", "error"};
    /* Those of an LMS, from the greatest value of its measuring mode down. */
    static const unsigned char lms[] = {1, 4, 6, 6, 5, 7, 6, 6, 2};
    if (i >= scanhub_count(scan))
        return NULL;
    const struct scanhub_scan_v2 *head = scanhub_scan_head(scan);
    const unsigned range = scanhub_ranges(scan)[i];
    if (range <= head->valid_to)
        return NULL;
    if (range != 0xFFFF && head->family == SCANHUB_FAMILY_LMS)
        return words[range <= head->no_return && head->no_return - range < 9u ? lms[head->no_return - range] : 6];
    return words[0xFFFFu - range < 7u ? 0xFFFFu - range : 7];
}

/* The intensity of beam i; -1 if the sensor does not send it, or the beam does not exist. */
static inline int32_t scanhub_intensity(const struct scanhub_sample *scan, unsigned i)
{
    const struct scanhub_scan_v2 *head = scanhub_scan_head(scan);
    if (i >= scanhub_count(scan) || head->intensity_bits == 0)
        return -1;
    if (head->contents & SCANHUB_SCAN_WIDE)
        return ((const uint16_t *)scanhub_scan_array(scan, SCANHUB_SCAN_ANGLES | 8))[i];
    if (head->contents & SCANHUB_SCAN_UPPER)
        return ((const uint8_t *)scanhub_scan_array(scan, SCANHUB_SCAN_ANGLES | 8 | SCANHUB_SCAN_WIDE))[i];
    return -1;
}

/* Points that were dropped because another point has the same beam. Points without a return count, too. */
static inline unsigned scanhub_collapsed(const struct scanhub_sample *scan)
{
    const struct scanhub_scan_v2 *head = scanhub_scan_head(scan);
    return head == NULL ? 0 : head->collapsed;
}

/* 1: packets of the turn are missing; what was in them is not measured. */
static inline int scanhub_is_incomplete(const struct scanhub_sample *scan)
{
    const struct scanhub_scan_v2 *head = scanhub_scan_head(scan);
    return head != NULL && (head->flags & 1) != 0;
}

/* When beam i was measured, in ns of CLOCK_MONOTONIC; 0 for a sample that is none. */
static inline uint64_t scanhub_beam_stamp_ns(const struct scanhub_sample *scan, unsigned i)
{
    const struct scanhub_scan_v2 *head = scanhub_scan_head(scan);
    if (head == NULL || scan->header == NULL)
        return 0;
    const unsigned turns = head->turns == 0 ? 1 : head->turns;
    const int64_t later_ns = (int64_t)i * head->beam_time_ns + (int64_t)(i % turns) * head->turn_ns;
    const int64_t at_ns = (int64_t)scan->header->stamp_first_ns + head->first_beam_ns + later_ns;
    return at_ns < 0 ? 0 : (uint64_t)at_ns;
}

/*
 * Samples of SCANHUB_TOPIC_FOREGROUND and SCANHUB_TOPIC_BACKGROUND.
 */

/* Whether there is all that the head of a foreground says. */
static inline int scanhub_foreground_is_whole(const struct scanhub_sample *foreground)
{
    const struct scanhub_foreground_v2 *head = (const struct scanhub_foreground_v2 *)foreground->payload;
    const size_t before = sizeof *head + 64 * sizeof(struct scanhub_segment_v2);
    if (foreground->length < before || head->segments > 64 || head->beams > head->count)
        return 0;
    return foreground->length >= before + 2 * (((size_t)head->count + 15) / 16) + 2 * (size_t)head->count;
}

/* The segments, as many as `segments`; NULL if the sample is none. */
static inline const struct scanhub_segment_v2 *scanhub_segments(const struct scanhub_sample *foreground)
{
    if (!scanhub_foreground_is_whole(foreground))
        return NULL;
    const void *at = (const unsigned char *)foreground->payload + sizeof(struct scanhub_foreground_v2);
    return (const struct scanhub_segment_v2 *)at;
}

/* 1: segment i has several beams, or the foreground of the scan before was near it. 0: it may be an edge that flickers, or
 * there is no such segment. */
static inline int scanhub_has_support(const struct scanhub_sample *foreground, unsigned i)
{
    const struct scanhub_foreground_v2 *head = (const struct scanhub_foreground_v2 *)foreground->payload;
    if (scanhub_segments(foreground) == NULL || i >= head->segments)
        return 0;
    return (int)(head->supported >> i & 1);
}

/* 1: beam i of the scan is in the foreground. */
static inline int scanhub_in_foreground(const struct scanhub_sample *foreground, unsigned i)
{
    const struct scanhub_segment_v2 *segments = scanhub_segments(foreground);
    if (segments == NULL || i >= ((const struct scanhub_foreground_v2 *)foreground->payload)->count)
        return 0;
    return ((const uint8_t *)(const void *)(segments + 64))[i / 8] >> (i % 8) & 1;
}

/* The ranges of the beams in the foreground, in their order, as many as `beams`, in device units; NULL if the sample is none. */
static inline const uint16_t *scanhub_foreground_ranges(const struct scanhub_sample *foreground)
{
    const struct scanhub_segment_v2 *segments = scanhub_segments(foreground);
    if (segments == NULL)
        return NULL;
    const size_t pairs = ((size_t)((const struct scanhub_foreground_v2 *)foreground->payload)->count + 15) / 16;
    return (const uint16_t *)(const void *)(segments + 64) + pairs;
}

/*
 * The ranges of a background, as many as `count`, in device units: 0 not known, 65535 beyond what the sensor measures; NULL if
 * the sample is none.
 */
static inline const uint16_t *scanhub_background_ranges(const struct scanhub_sample *background)
{
    const struct scanhub_background_v2 *head = (const struct scanhub_background_v2 *)background->payload;
    if (background->length < sizeof *head || background->length < sizeof *head + 2 * (size_t)head->count)
        return NULL;
    return (const uint16_t *)(const void *)(head + 1);
}

/* The points of a cloud, as many as `count`; NULL if the sample is none. */
static inline const struct scanhub_cloud_point_v2 *scanhub_cloud_points(const struct scanhub_sample *cloud)
{
    const struct scanhub_cloud_v2 *head = (const struct scanhub_cloud_v2 *)cloud->payload;
    if (cloud->length < sizeof *head
        || cloud->length < sizeof *head + sizeof(struct scanhub_cloud_point_v2) * (size_t)head->count)
        return NULL;
    return (const struct scanhub_cloud_point_v2 *)(const void *)(head + 1);
}

/* A compiler with another layout than the hub's stops here. */
#if defined(__cplusplus)
#define SCANHUB_MUST(name, what) static_assert(what, #name)
#elif defined(__STDC_VERSION__) && __STDC_VERSION__ >= 201112L
#define SCANHUB_MUST(name, what) _Static_assert(what, #name)
#else
#define SCANHUB_MUST(name, what) typedef char scanhub_must_##name[(what) ? 1 : -1]
#endif
#define SCANHUB_SIZE(type, size) SCANHUB_MUST(type, sizeof(struct type) == (size))
#define SCANHUB_AT(type, field, at) SCANHUB_MUST(type##_##field, offsetof(struct type, field) == (at))
SCANHUB_SIZE(scanhub_header_v2, 64);
SCANHUB_AT(scanhub_header_v2, sensor, 48);
SCANHUB_AT(scanhub_header_v2, hub_time, 61);
SCANHUB_SIZE(scanhub_scan_v2, 64);
SCANHUB_AT(scanhub_scan_v2, count, 32);
SCANHUB_AT(scanhub_scan_v2, turn_ns, 48);
SCANHUB_SIZE(scanhub_mark_v2, 16);
SCANHUB_SIZE(scanhub_marks_v2, 1028);
SCANHUB_AT(scanhub_marks_v2, mark_array, 4);
SCANHUB_SIZE(scanhub_line_v2, 40);
SCANHUB_SIZE(scanhub_corner_v2, 12);
SCANHUB_SIZE(scanhub_lines_v2, 3340);
SCANHUB_AT(scanhub_lines_v2, line_array, 12);
SCANHUB_AT(scanhub_lines_v2, corner_array, 2572);
SCANHUB_SIZE(scanhub_motion_v2, 120);
SCANHUB_AT(scanhub_motion_v2, covariance, 36);
SCANHUB_AT(scanhub_motion_v2, method, 76);
SCANHUB_AT(scanhub_motion_v2, pose_covariance, 80);
SCANHUB_SIZE(scanhub_zone_v2, 8);
SCANHUB_SIZE(scanhub_zones_v2, 76);
SCANHUB_AT(scanhub_zones_v2, zone_array, 12);
SCANHUB_SIZE(scanhub_early_v2, 12);
SCANHUB_AT(scanhub_early_v2, distance_mm, 4);
SCANHUB_SIZE(scanhub_track_v2, 80);
SCANHUB_AT(scanhub_track_v2, room_text, 48);
SCANHUB_AT(scanhub_track_v2, state, 72);
SCANHUB_SIZE(scanhub_track_sensor_v2, 72);
SCANHUB_AT(scanhub_track_sensor_v2, name_text, 16);
SCANHUB_SIZE(scanhub_tracks_v2, 7432);
SCANHUB_AT(scanhub_tracks_v2, sensor_array, 5128);
SCANHUB_SIZE(scanhub_event_v2, 112);
SCANHUB_AT(scanhub_event_v2, to_text, 88);
SCANHUB_SIZE(scanhub_tilt_v2, 16);
SCANHUB_SIZE(scanhub_cloud_v2, 16);
SCANHUB_AT(scanhub_cloud_v2, flags, 10);
SCANHUB_SIZE(scanhub_cloud_point_v2, 16);
SCANHUB_AT(scanhub_cloud_point_v2, point_class, 14);
SCANHUB_SIZE(scanhub_obstacle_v2, 48);
SCANHUB_AT(scanhub_obstacle_v2, flags, 44);
SCANHUB_SIZE(scanhub_obstacles_v2, 3088);
SCANHUB_AT(scanhub_obstacles_v2, obstacle_array, 16);
SCANHUB_SIZE(scanhub_segment_v2, 16);
SCANHUB_SIZE(scanhub_foreground_v2, 24);
SCANHUB_SIZE(scanhub_background_v2, 32);
SCANHUB_AT(scanhub_background_v2, count, 26);
SCANHUB_SIZE(scanhub_status_v2, 592);
SCANHUB_AT(scanhub_status_v2, counters, 336);
SCANHUB_AT(scanhub_status_v2, pose, 560);
#undef SCANHUB_AT
#undef SCANHUB_SIZE
#undef SCANHUB_MUST

#ifdef __cplusplus
}
#endif

#endif
