//! Shows the payload of each topic as a line of JSON and as a line for people, whether it was received through shared
//! memory or from a network.
//!
//! It follows from the table of topics: modules `json` and `text` have a function with the name of each topic.

use std::io;

use scanhub_client::streams::{RobotUpdate, Sample};
use scanhub_client::{Received, ZonesUpdate};
use scanhub_schema::{Background, Event, Header, Status, Zones};
use scanhub_shm::Payload;
use serde::Serialize;

use crate::output::{ExitReason, Output};
use crate::{json, text};

/// Takes the keys of one line.
pub trait Keys {
    /// Writes them.
    fn take(self, keys: impl Serialize) -> Result<(), ExitReason>;
}

impl Keys for &mut Output<'_> {
    fn take(self, keys: impl Serialize) -> Result<(), ExitReason> {
        self.json(&keys)
    }
}

/// The payload of a topic.
pub trait Show {
    /// The line of JSON, given to `to`.
    fn json(&self, sensor: &str, header: &Header, to: impl Keys) -> Result<(), ExitReason>;

    /// What stands behind the topic's name on a line for people.
    fn text(&self, header: &Header, line: &mut Vec<u8>) -> io::Result<()>;
}

/// Implements [`Show`] for the payloads of all topics, with the functions of `json` and `text` that have the topic's name.
macro_rules! shown {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        $(shown! { $payload, $name })*
    };
    // Implemented below.
    (Zones, $name:ident) => {};
    (Event, $name:ident) => { shown! { @impl Event, event(header) } };
    // Classes without the numbers and stamps of the sample.
    (Background, $name:ident) => { shown! { @impl Background, $name() } };
    (Status, $name:ident) => { shown! { @impl Status, $name() } };
    ($payload:tt, $name:ident) => {
        shown! { @impl scanhub_schema::payload_type!($payload), $name(header) }
    };
    (@impl $payload:ty, $function:ident($($header:ident)?)) => {
        impl Show for $payload {
            fn json(&self, sensor: &str, _header: &Header, to: impl Keys) -> Result<(), ExitReason> {
                to.take(json::$function(sensor, $(shown!(@ $header _header),)? self))
            }

            fn text(&self, _header: &Header, line: &mut Vec<u8>) -> io::Result<()> {
                text::$function(line, $(shown!(@ $header _header),)? self)
            }
        }
    };
    (@ header $header:ident) => { $header };
}

scanhub_schema::for_each_topic!(shown);

/// Shows the zones as they were received. The caller has checked their age.
impl Show for Zones {
    fn json(&self, sensor: &str, header: &Header, to: impl Keys) -> Result<(), ExitReason> {
        to.take(json::zones(sensor, &zones_update(self, header)))
    }

    fn text(&self, header: &Header, line: &mut Vec<u8>) -> io::Result<()> {
        text::zones(line, &zones_update(self, header))
    }
}

fn zones_update(zones: &Zones, header: &Header) -> ZonesUpdate {
    ZonesUpdate { zones: *zones, header: Some(*header), missed: 0, stale: false, as_published: *zones }
}

/// What was received.
trait ShowSample {
    fn json(&self, sensor: &str, to: impl Keys) -> Result<(), ExitReason>;
    fn text(&self, line: &mut Vec<u8>) -> io::Result<()>;
}

impl<P: Payload + Show + ?Sized> ShowSample for Received<P> {
    fn json(&self, sensor: &str, to: impl Keys) -> Result<(), ExitReason> {
        Show::json(&**self, sensor, self.header(), to)
    }

    fn text(&self, line: &mut Vec<u8>) -> io::Result<()> {
        Show::text(&**self, self.header(), line)
    }
}

impl ShowSample for ZonesUpdate {
    fn json(&self, sensor: &str, to: impl Keys) -> Result<(), ExitReason> {
        to.take(json::zones(sensor, self))
    }

    fn text(&self, line: &mut Vec<u8>) -> io::Result<()> {
        text::zones(line, self)
    }
}

impl ShowSample for RobotUpdate {
    fn json(&self, _sensor: &str, to: impl Keys) -> Result<(), ExitReason> {
        to.take(json::robot(&self.robot, &self.update))
    }

    fn text(&self, line: &mut Vec<u8>) -> io::Result<()> {
        text::robot(line, &self.robot)
    }
}

macro_rules! samples {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        /// The line of JSON of a sample of `sensor`.
        pub fn json(sample: &Sample, sensor: &str, to: impl Keys) -> Result<(), ExitReason> {
            match sample {
                $(Sample::$topic(sample) => sample.json(sensor, to),)*
                Sample::Robot(sample) => sample.json(sensor, to),
            }
        }

        /// What stands behind the topic's name on a line for people.
        pub fn text(sample: &Sample, line: &mut Vec<u8>) -> io::Result<()> {
            match sample {
                $(Sample::$topic(sample) => sample.text(line),)*
                Sample::Robot(sample) => sample.text(line),
            }
        }
    };
}

scanhub_schema::for_each_topic!(samples);
