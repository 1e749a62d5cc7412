//! Formats the payloads of all topics as JSON lines and lines of text. A payload may come from shared memory or from a
//! network.
//!
//! The code is generated from the table of topics. Modules `json` and `text` have a function with the name of each
//! topic.

use std::io;

use scanhub_client::streams::{RobotUpdate, Sample};
use scanhub_client::{Received, ZonesUpdate};
use scanhub_schema::{Background, Event, Header, Status, Zones};
use scanhub_shm::Payload;
use serde::Serialize;

use crate::output::{ExitReason, Output};
use crate::{json, text};

/// Destination of the keys of one line.
pub trait Keys {
    /// Writes the keys.
    fn take(self, keys: impl Serialize) -> Result<(), ExitReason>;
}

impl Keys for &mut Output<'_> {
    fn take(self, keys: impl Serialize) -> Result<(), ExitReason> {
        self.json(&keys)
    }
}

/// A payload that can be printed.
pub trait Show {
    /// Passes the JSON line to `to`.
    fn json(&self, sensor: &str, header: &Header, to: impl Keys) -> Result<(), ExitReason>;

    /// Writes the text after the topic's name.
    fn text(&self, header: &Header, line: &mut Vec<u8>) -> io::Result<()>;
}

/// Implements [`Show`] for the payloads of all topics. The implementation calls the functions of `json` and `text` that
/// have the topic's name.
macro_rules! shown {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        $(shown! { $payload, $name })*
    };
    // Zones have their own implementation below, because they are converted to an update first.
    (Zones, $name:ident) => {};
    (Event, $name:ident) => { shown! { @impl Event, event(header) } };
    // The lines of these classes do not have the sequence numbers and stamps of the sample.
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

/// Prints the zones as they were received. The caller must have checked their age.
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

/// A received sample that can be printed.
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
        /// Passes the JSON line of a sample of `sensor` to `to`.
        pub fn json(sample: &Sample, sensor: &str, to: impl Keys) -> Result<(), ExitReason> {
            match sample {
                $(Sample::$topic(sample) => sample.json(sensor, to),)*
                Sample::Robot(sample) => sample.json(sensor, to),
            }
        }

        /// Writes the text of a sample after the topic's name.
        pub fn text(sample: &Sample, line: &mut Vec<u8>) -> io::Result<()> {
            match sample {
                $(Sample::$topic(sample) => sample.text(line),)*
                Sample::Robot(sample) => sample.text(line),
            }
        }
    };
}

scanhub_schema::for_each_topic!(samples);
