//! Requests to a running hub, and its answers: the payloads of the control service. Refuses to know who carries out a
//! request.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

use crate::{BEAMS, Background, Failure, Kind, text};

/// What a request asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u16)]
pub enum Verb {
    /// Stop the sensor; its link stays.
    Pause = 1,
    /// Let the sensor stream again.
    Resume = 2,
    /// Restart the session with the sensor.
    Resync = 3,
    /// Return the background model.
    Show = 16,
    /// Forget the background model and learn it again.
    Reset = 17,
    /// Freeze the background model.
    Freeze = 18,
    /// Continue learning the background model.
    Thaw = 19,
    /// Use the ranges of the request as the background model.
    Load = 20,
}

impl Verb {
    /// Requests about the flow of data, in the order of all output.
    pub const FLOW: [Verb; 3] = [Verb::Pause, Verb::Resume, Verb::Resync];
    /// Requests about the background model, in the order of all output.
    pub const BACKGROUND: [Verb; 5] = [Verb::Show, Verb::Reset, Verb::Freeze, Verb::Thaw, Verb::Load];

    /// Returns all verbs.
    pub fn all() -> impl Iterator<Item = Verb> {
        Verb::FLOW.into_iter().chain(Verb::BACKGROUND)
    }

    /// Returns the verb's name on the command line and in all output.
    pub fn name(self) -> &'static str {
        match self {
            Verb::Pause => "pause",
            Verb::Resume => "resume",
            Verb::Resync => "resync",
            Verb::Show => "show",
            Verb::Reset => "reset",
            Verb::Freeze => "freeze",
            Verb::Thaw => "thaw",
            Verb::Load => "load",
        }
    }

    /// Returns the verb called `name`.
    pub fn parse(name: &str) -> Option<Verb> {
        Verb::all().find(|verb| verb.name() == name)
    }
}

/// A request, 848 bytes. Fields that a verb does not use are 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Request.v1"))]
#[repr(C)]
pub struct Request {
    /// See [`Request::sensor`].
    pub sensor_text: [u8; 32],
    /// See [`Request::verb`].
    pub verb: u16,
    /// Ranges used, at most [`BEAMS`].
    pub count: u16,
    /// Millimetres per unit of the ranges.
    pub unit_mm: u8,
    /// 0.
    pub reserved: [u8; 3],
    /// Ranges in device units; 0 beyond `count`.
    pub range_array: [u16; BEAMS],
    /// 0.
    pub pad: [u8; 6],
}

impl Request {
    /// Asks for `verb` at `sensor`, a name of at most 32 bytes.
    pub fn new(sensor: &str, verb: Verb) -> Request {
        let mut request = Request { verb: verb as u16, ..Zeroable::zeroed() };
        text::write(&mut request.sensor_text, sensor);
        request
    }

    /// Asks `sensor` to use the ranges of `model` as its background.
    pub fn load(sensor: &str, model: &Background) -> Request {
        let mut request = Request::new(sensor, Verb::Load);
        request.count = model.count;
        request.unit_mm = model.unit_mm;
        request.range_array = model.range_array;
        request
    }

    /// Returns the model that it brings, for [`Verb::Load`]: generation and flags are 0.
    pub fn model(&self) -> Background {
        let mut model = Background {
            count: self.count.min(BEAMS as u16),
            unit_mm: self.unit_mm,
            ..Background::default()
        };
        let used = usize::from(model.count);
        model.range_array[..used].copy_from_slice(&self.range_array[..used]);
        model.taught = model.ranges().iter().filter(|&&range| range != Background::UNTAUGHT).count() as u16;
        model
    }

    /// Returns the sensor that is meant.
    pub fn sensor(&self) -> &str {
        text::read(&self.sensor_text)
    }

    /// Returns the verb; nothing if a newer client has one that this program does not know.
    pub fn verb(&self) -> Option<Verb> {
        Verb::all().find(|verb| *verb as u16 == self.verb)
    }
}

/// A background model in a response.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Shown {
    /// As it is now.
    pub model: Background,
    /// When the model was saved that the next hub starts with, in nanoseconds since 1970; nothing if there is none.
    pub kept_wall_ns: Option<u64>,
}

impl From<Background> for Shown {
    /// A model that is not saved.
    fn from(model: Background) -> Shown {
        Shown { model, kept_wall_ns: None }
    }
}

/// An answer: success, with the requested model if there is one, or a failure. Its bytes are exit code and message length
/// (two bytes each, little-endian), then the message, then the packed model. The second line of the message of a failure
/// is the remedy; with a model, it is the time at which a model was saved, in decimal digits.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Response(pub Result<Option<Shown>, Failure>);

impl Response {
    /// The longest response in bytes; a message beyond it is cut.
    pub const MAX: usize = 1024;

    /// Returns the response as bytes.
    pub fn encode(&self) -> Vec<u8> {
        let (code, said) = match &self.0 {
            Ok(shown) => {
                let kept = shown.as_ref().and_then(|shown| shown.kept_wall_ns);
                (0, kept.map(|wall_ns| wall_ns.to_string()).unwrap_or_default())
            }
            Err(failure) => (failure.kind.exit_code(), format!("{}\n{}", failure.message, failure.hint)),
        };
        let mut message = vec![0; said.trim_end().len().min(Response::MAX - HEAD)];
        text::write(&mut message, said.trim_end());
        let head = [u16::from(code), message.len() as u16].map(u16::to_le_bytes);
        let model = self.0.as_ref().ok().and_then(Option::as_ref);
        let model = model.map_or(&[][..], |shown| shown.model.packed());
        [head.as_flattened(), &message, model].concat()
    }

    /// Returns the response in `bytes`, if that is one. A code that no kind of failure has is [`Kind::Failed`].
    pub fn decode(bytes: &[u8]) -> Option<Response> {
        let (&[code_low, code_high, low, high], rest) = bytes.split_first_chunk()?;
        let (message, model) = rest.split_at_checked(usize::from(u16::from_le_bytes([low, high])))?;
        let (message, code) = (text::read(message), u16::from_le_bytes([code_low, code_high]));
        if code == 0 {
            let kept_wall_ns = message.parse().ok();
            return Some(Response(Ok(match model {
                [] => None,
                model => Some(Shown { model: Background::unpack(model)?, kept_wall_ns }),
            })));
        }
        let kind = ANSWERS.into_iter().find(|kind| u16::from(kind.exit_code()) == code);
        let (message, hint) = message.split_once('\n').unwrap_or((message, ""));
        Some(Response(Err(Failure::new(kind.unwrap_or(Kind::Failed), message, hint))))
    }
}

/// Exit code and message length.
const HEAD: usize = 4;

/// The failures that a hub answers with; each exit code stands for one of them.
const ANSWERS: [Kind; 4] = [Kind::Failed, Kind::NoTopic, Kind::Short, Kind::Configuration];

const _: () = assert!(HEAD + Background::MAX_PACKED <= Response::MAX);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn verbs_go_there_and_back() {
        for verb in Verb::all() {
            assert_eq!(Verb::parse(verb.name()), Some(verb));
            let request = Request::new("front", verb);
            assert_eq!((request.sensor(), request.verb()), ("front", Some(verb)));
        }
        let unknown = Request { verb: 99, ..Request::new("front", Verb::Pause) };
        assert_eq!((unknown.verb(), Verb::parse("stop")), (None, None));
    }

    #[test]
    fn responses_go_there_and_back() {
        let failure = |kind, hint: &str| Response(Err(Failure::new(kind, "front: no", hint)));
        let model = Background { count: 361, generation: 7, ..Background::default() };
        for response in [
            Response(Ok(None)),
            Response(Ok(Some(model.into()))),
            Response(Ok(Some(Shown { model, kept_wall_ns: Some(u64::MAX) }))),
            failure(Kind::Failed, ""),
            failure(Kind::Short, "later"),
            failure(Kind::NoTopic, "a, b"),
        ] {
            assert_eq!(Response::decode(&response.encode()), Some(response));
        }
        let long = Response(Err(Failure::new(Kind::Failed, "é".repeat(2000), ""))).encode();
        assert!(long.len() <= Response::MAX && Response::decode(&long).is_some());
    }

    #[test]
    fn what_is_no_response() {
        for bytes in [&[][..], &[0, 0, 1], &[1, 0, 2, 0, b'a'], &[0, 0, 0, 0, 1]] {
            assert_eq!(Response::decode(bytes), None);
        }
        let unknown = Response::decode(&[200, 1, 1, 0, b'a']).unwrap();
        assert_eq!(unknown, Response(Err(Failure::new(Kind::Failed, "a", ""))));
    }
}
