//! What the numbers of a topic's samples tell a consumer: how many it missed, and that the hub was restarted. Refuses to know
//! how samples come.

use scanhub_schema::{Flags, Header};

/// The numbers of one topic of one sensor, as one consumer meets them.
#[derive(Clone, Debug, Default)]
pub struct Numbers {
    boot: Option<u64>,
    expected: Option<u64>,
}

/// What the numbers of a sample tell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Noted {
    /// Samples of this topic that were sent before this one and not received.
    pub missed: u64,
    /// The hub was restarted since the last sample: its numbers start again at 0.
    pub restarted: bool,
}

impl Numbers {
    /// Begins wherever the next sample is: its port is a new one.
    pub fn begin_anew(&mut self) {
        self.expected = None;
    }

    /// Takes the sample with `header`. A port that outlived its hub got everything of the next hub from number 0; a new one
    /// begins where it is.
    pub fn note(&mut self, header: &Header) -> Noted {
        let restarted = self.boot.is_some_and(|boot| boot != header.boot);
        // A network's numbers go on, whatever becomes of the hub at its other end.
        let is_remote = header.flags & Flags::REMOTE != 0;
        if restarted && !is_remote && self.expected.is_some() {
            self.expected = Some(0);
        }
        let missed = self.expected.map_or(0, |expected| header.topic_seq.saturating_sub(expected));
        self.boot = Some(header.boot);
        self.expected = Some(header.topic_seq + 1);
        Noted { missed, restarted }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_count_and_another_hub_begins_at_0() {
        let mut numbers = Numbers::default();
        let mut note = |boot, topic_seq, flags| {
            let Noted { missed, restarted } =
                numbers.note(&Header { boot, topic_seq, flags, ..Header::default() });
            (missed, restarted)
        };
        assert_eq!((note(1, 7, 0), note(1, 8, 0), note(1, 11, 0)), ((0, false), (0, false), (2, false)));
        assert_eq!((note(2, 3, 0), note(2, 4, 0)), ((3, true), (0, false)));
        assert_eq!(note(3, 9, Flags::REMOTE), (4, true), "a network's numbers go on");
        numbers.begin_anew();
        let later = Header { boot: 3, topic_seq: 50, ..Header::default() };
        assert_eq!(numbers.note(&later), Noted { missed: 0, restarted: false });
    }
}
