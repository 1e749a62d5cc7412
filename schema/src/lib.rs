//! The interface between hub and clients: topics with their payloads and names, and the format of datagrams and
//! recordings. This crate makes no system calls: the crate `shm` puts payloads into shared memory.

#![forbid(unsafe_code)]

mod background;
mod control;
pub mod csv;
pub mod datagram;
mod family;
#[cfg(feature = "mcap")]
pub mod file;
mod header;
mod landmarks;
mod motion;
mod payload;
mod renamed;
mod scan;
mod status;
mod text;
mod tilt;
mod time;
mod topic;
mod tracks;
mod zones;

#[cfg(feature = "json")]
mod background_file;
pub mod limits;

/// The payloads of all topics, with the types of their fields. The client library re-exports these types.
pub mod payloads {
    pub use crate::background::*;
    pub use crate::family::*;
    pub use crate::landmarks::*;
    pub use crate::motion::*;
    pub use crate::scan::*;
    pub use crate::status::*;
    pub use crate::tilt::*;
    pub use crate::tracks::*;
    pub use crate::zones::*;
}

pub use control::{Request, Response, ResponseModel, Verb};
pub use header::{Flags, Header, Quality, Reasons};
pub use payloads::*;
pub use renamed::renamed;
pub use text::{Failure, Kind, Printable, escape_json, json_line};
pub use time::{Age, MICROS, MILLIS, MIN_RATE_SPAN, Nanos, line_time, rate_hz};
pub use topic::{
    CONTROL, CONTROL_REQUEST, CONTROL_RESPONSE, DoorbellWord, PublishRate, PublisherKind, ROBOT, Topic,
    TopicSpec, WAKE, WakeEvent, check_any_sensor, check_sensor, is_remote, parse_service_name,
};

#[cfg(feature = "json")]
pub use background_file::{BackgroundFile, as_json, unit_in_mm};
