//! The interface between hub and clients: topics with their payloads and names, the format of datagrams and recordings,
//! and the services in shared memory. Without feature `ipc`, it is plain bytes and names, enough for a receiver on a
//! network.

mod background;
mod control;
pub mod csv;
pub mod datagram;
mod domain;
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

#[cfg(feature = "ipc")]
mod directory;
#[cfg(feature = "ipc")]
pub mod ipc;
pub mod limits;
#[cfg(feature = "ipc")]
mod lock;
#[cfg(feature = "output")]
pub mod output;
#[cfg(any(feature = "ipc", feature = "output"))]
#[cfg_attr(
    not(all(feature = "ipc", feature = "output")),
    allow(dead_code, reason = "a domain has stricter rules than an output file")
)]
mod path_walk;
#[cfg(feature = "files")]
pub mod regular;
#[cfg(feature = "ipc")]
mod running;
#[cfg(feature = "json")]
mod saved;
#[cfg(feature = "ipc")]
pub mod shortage;
#[cfg(feature = "ipc")]
mod state;

pub use background::{
    Background, BackgroundHead, BackgroundWord, Foreground, ForegroundArrays, ForegroundHead, ForegroundWord,
    SEGMENTS, Segment,
};
pub use control::{Request, Response, Shown, Verb};
pub use domain::{DEFAULT_DOMAIN, Domain, Environment};
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

#[cfg(feature = "ipc")]
pub use directory::Directory;
#[cfg(feature = "ipc")]
pub use lock::{HubLock, ListenLock, NameLock, holder, is_starting, name_held, publisher, publisher_domain};
#[cfg(feature = "ipc")]
pub use running::{RunningHub, shell_word};
#[cfg(feature = "json")]
pub use saved::{SavedModel, as_json, unit_in_mm};
#[cfg(feature = "ipc")]
pub use state::StateDirectory;
