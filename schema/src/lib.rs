//! What hub and clients share: what the hub publishes, and under which names. Knows no serial line, no configuration and
//! no verb. Without feature `ipc` it is plain bytes and names, enough for a receiver on a network.

mod age;
mod background;
mod cloud;
mod control;
pub mod csv;
pub mod datagram;
mod domain;
mod early;
mod event;
mod failure;
#[cfg(feature = "mcap")]
pub mod file;
mod foreground;
mod header;
mod lines;
mod marks;
mod motion;
mod obstacles;
mod pose;
mod printable;
mod rate;
mod scan;
mod sliced;
mod status;
mod sweep;
mod telegram;
mod text;
mod tilt;
mod time;
mod topic;
mod tracks;
mod zones;

#[cfg(feature = "ipc")]
mod access;
#[cfg(feature = "ipc")]
mod directory;
#[cfg(feature = "ipc")]
pub mod ipc;
pub mod limits;
#[cfg(feature = "ipc")]
mod lock;
#[cfg(feature = "ipc")]
mod prefix;
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

pub use age::Age;
pub use background::{Background, BackgroundHead, BackgroundWord};
pub use cloud::{Cloud, CloudHead, CloudPoint, CloudWord, PointClass};
pub use control::{Request, Response, Shown, Verb};
pub use domain::{DEFAULT_DOMAIN, Domain, Environment};
pub use early::Early;
pub use event::{Event, EventKind};
pub use failure::{Failure, Kind};
pub use foreground::{Foreground, ForegroundArrays, ForegroundHead, ForegroundWord, SEGMENTS, Segment};
pub use header::{Flags, Header, Quality, Reasons};
pub use lines::{Corner, LINES, Line, Lines};
pub use marks::{MARKS, Mark, Marks};
pub use motion::{Motion, MotionMethod};
pub use obstacles::{OBSTACLES, Obstacle, Obstacles};
pub use pose::Pose;
pub use printable::{Printable, escape_json, json_line};
pub use rate::{MIN_RATE_SPAN, rate_hz};
pub use scan::{
    BEAMS, Code, Contents, Family, Intensities, PacketFacts, Scan, ScanArrays, ScanHead, ScanWord,
    in_degrees, in_sector_mdeg,
};
pub use status::{COUNTERS, Counter, Counters, State, Status};
pub use sweep::SweepPoints;
pub use telegram::Telegram;
pub use tilt::Tilt;
pub use time::{MICROS, MILLIS, Nanos, line_time};
pub use topic::{
    CONTROL, CONTROL_REQUEST, CONTROL_RESPONSE, Maker, Pace, ROBOT, Ring, Row, Topic, WAKE, Wake,
    check_followed, check_sensor, is_remote, of_service,
};
pub use tracks::{TRACK_SENSORS, TRACKS, Track, TrackSensor, TrackState, Tracks};
pub use zones::{Verdict, ZONES, Zone, Zones};

#[cfg(feature = "ipc")]
pub use directory::Directory;
#[cfg(feature = "ipc")]
pub use lock::{HubLock, ListenLock, NameLock, holder, publisher};
#[cfg(feature = "ipc")]
pub use running::{RunningHub, shell_word};
#[cfg(feature = "json")]
pub use saved::{SavedModel, as_json, unit_in_mm};
#[cfg(feature = "ipc")]
pub use state::StateDirectory;
