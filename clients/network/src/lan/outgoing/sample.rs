//! A sample as it is handed to a network's end: borrowed, wherever it lies. Refuses to know where that is.

use scanhub_schema::datagram::Packed;
use scanhub_schema::{Header, Topic};

/// A sample of a topic, or the word that none comes.
#[derive(Clone, Copy, Debug)]
pub struct Sample<'a> {
    /// Numbers, stamps and quality; nothing if nobody sent it: then it stands for a silence.
    pub header: Option<&'a Header>,
    /// Samples of the topic that were sent before it and did not come here.
    pub missed: u64,
    /// What it says, and of which topic it is.
    pub payload: PayloadRef<'a>,
}

/// Declares from the table of topics what a sample may say.
macro_rules! payloads {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        /// The payload of any topic.
        #[derive(Clone, Copy, Debug)]
        pub enum PayloadRef<'a> {
            $(#[doc = $about] $topic(&'a scanhub_schema::payload_type!($payload)),)*
        }

        impl PayloadRef<'_> {
            /// Returns the topic that carries it.
            pub fn topic(self) -> Topic {
                match self { $(PayloadRef::$topic(_) => Topic::$topic,)* }
            }

            /// Writes it as it goes over a network to the beginning of `room`, and returns its length; nothing if there is
            /// too little room.
            pub fn pack(self, room: &mut [u8]) -> Option<usize> {
                match self { $(PayloadRef::$topic(payload) => payload.pack(room),)* }
            }
        }
    };
}

scanhub_schema::for_each_topic!(payloads);

#[cfg(test)]
mod tests {
    use super::*;

    use scanhub_schema::Zones;

    #[test]
    fn a_payload_knows_its_topic_and_packs_itself() {
        let (mut room, unknown) = ([0; 20], Zones::unknown());
        let (zones, telegram) = (PayloadRef::Zones(&unknown), PayloadRef::Telegram(&[2, 0x80, 0]));
        assert_eq!((zones.topic(), telegram.topic()), (Topic::Zones, Topic::Telegram));
        assert_eq!((zones.pack(&mut room), zones.pack(&mut room[..11])), (Some(12), None));
        assert_eq!((telegram.pack(&mut room), telegram.pack(&mut room[..2])), (Some(3), None));
        assert_eq!(room[..3], [2, 0x80, 0]);
    }
}
