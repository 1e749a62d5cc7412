//! Responses that a stream file needs before its first packets. Packets of the types 0x82 and 0x85 look alike, and no packet
//! contains the model, the mode, or the time per point. A scanner reports them before its stream, but a recording may begin
//! later.
//!
//! The responses have the form in which a scanner sends them, so a session reads them like those of a line.

use crate::rplidar::device_info::Info;
use crate::rplidar::model::Mode;
use crate::rplidar::packet::Kind;
use crate::rplidar::request::{Answer, Head, key};

/// Facts that the responses report.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StreamHead {
    /// Identity of the scanner, if it is known.
    pub(crate) info: Option<Info>,
    /// Mode of the stream, if scanhub knows it.
    pub(crate) mode: Option<Mode>,
    /// Microseconds per point, if they are known.
    pub(crate) sample_us: Option<f64>,
    /// Kind of the packets.
    pub(crate) kind: Kind,
}

impl StreamHead {
    /// Encodes the responses: the identity, a list of modes that contains only the one of the stream, and the descriptor of the
    /// packets.
    pub(crate) fn encode(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        if let Some(info) = &self.info {
            push(&mut bytes, Answer::Info, &info.encode());
        }
        let mut value = |key: u8, value: &[u8]| {
            push(&mut bytes, Answer::Configuration, &[&[key, 0, 0, 0], value].concat());
        };
        value(key::COUNT, &[1, 0]);
        if let Some(us) = self.sample_us {
            value(key::SAMPLE_TIME, &((us * 256.0).round() as u32).to_le_bytes());
        }
        value(key::ANSWER, &[self.kind.answer()]);
        if let Some(mode) = self.mode {
            value(key::NAME, &[mode.name().as_bytes(), &[0]].concat());
        }
        bytes.extend(Head::Stream(self.kind).encode());
        bytes
    }
}

fn push(bytes: &mut Vec<u8>, answer: Answer, data: &[u8]) {
    bytes.extend(Head::Reply(answer, data.len()).encode());
    bytes.extend(data);
}
