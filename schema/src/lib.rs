//! The interface between hub and clients: topics with their payloads and names, and the format of datagrams and
//! recordings. It makes no system calls: the crate `shm` puts payloads into shared memory.

#![forbid(unsafe_code)]

mod background;
mod control;
pub mod csv;
pub mod datagram;
mod failure;
#[cfg(feature = "mcap")]
pub mod file;
mod header;
mod landmarks;
mod motion;
mod pose;
mod scan;
mod sliced;
mod status;
mod telegram;
mod text;
mod tilt;
mod time;
mod topic;
mod tracks;
mod zones;

pub mod limits;
#[cfg(feature = "json")]
mod saved;

pub use background::{
    Background, BackgroundHead, BackgroundWord, Foreground, ForegroundArrays, ForegroundHead, ForegroundWord,
    SEGMENTS, Segment,
};
pub use control::{Request, Response, Shown, Verb};
pub use failure::{Failure, Kind};
pub use header::{Flags, Header, Quality, Reasons};
pub use landmarks::{Corner, LINES, Line, Lines, MARKS, Mark, Marks};
pub use motion::{Motion, MotionMethod};
pub use pose::Pose;
pub use scan::{
    BEAMS, Code, Contents, Family, Intensities, PacketFacts, Scan, ScanArrays, ScanHead, ScanWord,
    in_degrees, in_sector_mdeg,
};
pub use status::{COUNTERS, Counter, Counters, State, Status};
pub use telegram::Telegram;
pub use text::{Printable, escape_json, json_line};
pub use tilt::{
    Cloud, CloudHead, CloudPoint, CloudWord, OBSTACLES, Obstacle, Obstacles, PointClass, SweepPoints, Tilt,
};
pub use time::{Age, MICROS, MILLIS, MIN_RATE_SPAN, Nanos, line_time, rate_hz};
pub use topic::{
    CONTROL, CONTROL_REQUEST, CONTROL_RESPONSE, Maker, Pace, ROBOT, Ring, Row, Topic, WAKE, Wake,
    check_followed, check_sensor, is_remote, of_service,
};
pub use tracks::{Event, EventKind, TRACK_SENSORS, TRACKS, Track, TrackSensor, TrackState, Tracks};
pub use zones::{Early, Verdict, ZONES, Zone, Zones};

#[cfg(feature = "json")]
pub use saved::{SavedModel, as_json, unit_in_mm};
