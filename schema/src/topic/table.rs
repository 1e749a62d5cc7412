//! The table of topics: one row has everything that differs between them. All code for each topic, here and in other
//! crates, is generated from this table, so a new topic is a new row.

use crate::limits::TopicLimits;

/// Calls the macro `$each` with all rows of the table. A row is `VARIANT PAYLOAD, name, type, group, pace, ring,
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
            Telegram [u8], "telegram", "u8[]", 83, Scan, First, 64, 0:
                "The bytes of telegrams, replies too.";
            Scan Scan, "scan", "scanhub.Scan.v2", 82, Scan, First, 64, 0:
                "Decoded measurements.";
            Marks Marks, "marks", "scanhub.Marks.v2", 81, Scan, Last, 16, 0:
                "Reflector marks.";
            Zones Zones, "zones", "scanhub.Zones.v2", 81, Scan, First, 16, 1:
                "What is near the robot.";
            Foreground Foreground, "foreground", "scanhub.Foreground.v2", 81, Scan, Last, 16, 0:
                "What stands in front of the background.";
            Background Background, "background", "scanhub.Background.v2", 82, Change, Last, 4, 1:
                "The background model.";
            Status Status, "status", "scanhub.Status.v2", 80, Second, Last, 4, 1:
                "State, properties and counters of the link.";
            Lines Lines, "lines", "scanhub.Lines.v2", 81, Scan, Last, 16, 0:
                "Straight lines and their corners.";
            Motion Motion, "motion", "scanhub.Motion.v2", 81, Scan, Last, 16, 0:
                "How the robot moved since the scan before.";
            Early Early, "early", "scanhub.Early.v2", 81, Change, Early, 16, 0:
                "Warnings by telegrams that are not complete.";
            Tracks Tracks, "tracks", "scanhub.Tracks.v2", 81, Scan, Last, 16, 0:
                "Where people are, of a tracker.";
            Events Event, "events", "scanhub.Event.v2", 81, Change, Last, 64, 0:
                "What happened to them.";
            Tilt Tilt, "tilt", "scanhub.Tilt.v2", 81, Scan, Last, 64, 0:
                "The angle of a mount.";
            Cloud Cloud, "cloud", "scanhub.Cloud.v2", 82, Change, Last, 128, 0:
                "Points in three dimensions.";
            Obstacles Obstacles, "obstacles", "scanhub.Obstacles.v2", 81, Change, Last, 16, 0:
                "What stands there in three dimensions.";
        }
    };
}

/// The type of a row's payload in [`for_each_topic!`](crate::for_each_topic), wherever that is called.
///
/// # Examples
///
/// ```
/// assert_eq!(size_of::<schema::payload_type!(Marks)>(), 1028);
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
    /// Which ring of the bell tells of its samples.
    pub ring: Ring,
    /// Samples that wait for a consumer; with one more, the oldest is dropped. What a recorder must not lose waits for 1.7 s:
    /// on a machine that stood still for 0.6 s, one lost 7 scans of 16 that could wait.
    pub waiting: usize,
    /// Samples that a late consumer gets.
    pub kept: usize,
    /// Returns the bytes of the longest payload of a topic that is made as is said.
    pub longest: fn(&TopicLimits) -> usize,
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

/// The rings of a sensor's bell for a telegram: nobody waits for the marks of a scan whose zones he wants.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ring {
    /// As soon as telegram, scan and zones are sent.
    First,
    /// When all is sent.
    Last,
    /// Before it is complete, if it is a warning already.
    Early,
}

impl Ring {
    /// All of them.
    pub const ALL: [Ring; 3] = [Ring::First, Ring::Last, Ring::Early];
}

macro_rules! rows {
    ($($topic:ident $payload:tt, $name:literal, $kind:literal, $group:literal, $pace:ident,
        $ring:ident, $waiting:literal, $kept:literal: $about:literal;)*) => {
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
            ring: Ring::$ring,
            waiting: $waiting,
            kept: $kept,
            longest: longest!($payload),
        },)*];
    };
}

macro_rules! longest {
    ([u8]) => {
        |limits| limits.telegram
    };
    (Scan) => {
        |limits| crate::Scan::len(limits.beams, limits.contents)
    };
    (Foreground) => {
        |limits| crate::Foreground::len(limits.beams)
    };
    (Background) => {
        |limits| crate::Background::len(limits.beams)
    };
    (Cloud) => {
        |limits| crate::Cloud::len(limits.beams)
    };
    ($payload:tt) => {
        |_| size_of::<crate::$payload>()
    };
}

crate::for_each_topic!(rows);

#[cfg(test)]
mod tests {
    #[allow(unreachable_pub)]
    mod with_one_more {
        use super::super::{Pace, Ring, Row};

        rows! {
            Telegram [u8], "telegram", "u8[]", 83, Scan, First, 16, 0: "Bytes.";
            Beat Marks, "beat", "scanhub.Beat.v1", 82, Change, Last, 2, 1: "A throw-away topic.";
        }
    }

    #[test]
    fn a_row_is_all_that_a_topic_needs_here() {
        use with_one_more::{ROWS, Topic};
        assert_eq!(Topic::ALL, [Topic::Telegram, Topic::Beat]);
        let row = &ROWS[Topic::Beat as usize];
        assert_eq!((row.name, row.pace, row.ring), ("beat", super::Pace::Change, super::Ring::Last));
        assert_eq!((row.waiting, row.kept), (2, 1));
        let limits = crate::limits::TopicLimits::default();
        assert_eq!((row.longest)(&limits), size_of::<crate::Marks>());
        assert_eq!((ROWS[0].longest)(&limits), crate::Telegram::MAX);
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
