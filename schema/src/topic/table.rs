//! The table of topics: one row has everything that differs between them. All code for each topic, here and in other
//! crates, is generated from this table, so a new topic is a new row.

use crate::{Header, Telegram};

/// Calls the macro `$each` with all rows of the table. A row is `VARIANT PAYLOAD, name, type, group, pace, consumers,
/// waiting, kept: description;`, its columns those of [`Row`]; a payload other than `[u8]` is a type of this crate.
///
/// # Examples
///
/// ```
/// macro_rules! names {
///     ($($topic:ident $payload:tt, $name:literal, $($column:tt),*: $description:literal;)*) => { [$($name),*] };
/// }
/// let names = schema::for_each_topic!(names);
/// assert_eq!(names[1], "scan");
/// ```
#[macro_export]
macro_rules! for_each_topic {
    ($each:ident) => {
        $each! {
            Telegram [u8], "telegram", "u8[]", 83, Scan, 32, 16, 0:
                "The bytes of telegrams, replies too.";
            Scan Scan, "scan", "scanhub.Scan.v1", 82, Scan, 200, 16, 0:
                "Decoded measurements.";
            Marks Marks, "marks", "scanhub.Marks.v1", 81, Scan, 32, 16, 0:
                "Reflector marks.";
            Zones Zones, "zones", "scanhub.Zones.v1", 81, Scan, 200, 16, 1:
                "What is near the robot.";
            Foreground Foreground, "foreground", "scanhub.Foreground.v1", 81, Scan, 32, 16, 0:
                "What stands in front of the background.";
            Background Background, "background", "scanhub.Background.v1", 82, Change, 32, 4, 1:
                "The background model.";
            Status Status, "status", "scanhub.Status.v1", 80, Second, 64, 4, 1:
                "State, properties and counters of the link.";
        }
    };
}

/// The type of a row's payload in [`for_each_topic!`](crate::for_each_topic), wherever that is called.
///
/// # Examples
///
/// ```
/// assert_eq!(size_of::<schema::payload_type!(Scan)>(), 1216);
/// let telegram: &schema::payload_type!([u8]) = &[2, 0x80];
/// ```
#[macro_export]
macro_rules! payload_type {
    ([u8]) => {
        [u8]
    };
    ($payload:ident) => {
        $crate::$payload
    };
}

/// All that differs between topics, beside what their payloads say.
#[derive(Clone, Copy, Debug)]
pub struct Row {
    /// As in `front/scan`.
    pub name: &'static str,
    /// The payload's type, the same in all languages.
    pub payload: &'static str,
    /// The last byte of the multicast group that it goes to.
    pub group: u8,
    /// How often a sample is sent.
    pub pace: Pace,
    /// Consumers at a time. For each sample the shared-memory library looks at all places three times, and they are far apart
    /// in memory: if only few programs follow, many places cost more than the sample.
    pub consumers: usize,
    /// Samples that wait for a consumer; with one more, the oldest is dropped. For topics sent with each scan this is 0.4 s: a
    /// recorder on a loaded machine can be without a processor for longer than four scans.
    pub waiting: usize,
    /// Samples that a late consumer gets.
    pub kept: usize,
    /// Bytes of the longest payload and its header.
    pub bytes: usize,
}

/// How often a sample of a topic is sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// With each scan.
    Scan,
    /// Each second, and when it changes.
    Second,
    /// When there is a new one.
    Change,
}

macro_rules! rows {
    ($($topic:ident $payload:tt, $name:literal, $kind:literal, $group:literal, $pace:ident,
        $consumers:literal, $waiting:literal, $kept:literal: $about:literal;)*) => {
        /// What the hub publishes for each sensor.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum Topic {
            $(#[doc = $about] $topic,)*
        }

        impl Topic {
            /// All topics, in the order of all output.
            pub const ALL: [Topic; [$($name),*].len()] = [$(Topic::$topic),*];
        }

        /// One for each of [`Topic::ALL`].
        pub(super) const ROWS: [Row; Topic::ALL.len()] = [$(Row {
            name: $name,
            payload: $kind,
            group: $group,
            pace: Pace::$pace,
            consumers: $consumers,
            waiting: $waiting,
            kept: $kept,
            bytes: size_of::<Header>() + longest!($payload),
        },)*];
    };
}

macro_rules! longest {
    ([u8]) => {
        Telegram::MAX
    };
    ($payload:tt) => {
        size_of::<crate::$payload>()
    };
}

crate::for_each_topic!(rows);

#[cfg(test)]
mod tests {
    #[allow(unreachable_pub)]
    mod with_one_more {
        use super::super::{Pace, Row, Telegram};
        use crate::Header;

        rows! {
            Telegram [u8], "telegram", "u8[]", 83, Scan, 32, 16, 0: "Bytes.";
            Beat Marks, "beat", "scanhub.Beat.v1", 82, Change, 8, 2, 1: "A throw-away topic.";
        }
    }

    #[test]
    fn a_row_is_all_that_a_topic_needs_here() {
        use with_one_more::{ROWS, Topic};
        assert_eq!(Topic::ALL, [Topic::Telegram, Topic::Beat]);
        let row = &ROWS[Topic::Beat as usize];
        assert_eq!((row.name, row.pace, row.consumers, row.kept), ("beat", super::Pace::Change, 8, 1));
        assert_eq!(row.bytes, size_of::<crate::Header>() + size_of::<crate::Marks>());
    }

    #[test]
    fn names_and_types_are_unique_and_a_status_goes_where_announcements_go() {
        let rows = super::Topic::ALL.map(super::Topic::row);
        for (number, row) in rows.iter().enumerate() {
            let others = &rows[..number];
            assert!(others.iter().all(|other| other.name != row.name && other.payload != row.payload));
        }
        assert_eq!(super::Topic::Status.row().group, crate::datagram::Announce::GROUP);
    }
}
