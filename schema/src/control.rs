//! Requests to a running hub, and its responses: the payloads of the control service.

use crate::{Background, Failure, Kind, text};

/// Command of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u16)]
pub enum Verb {
    /// Stop the sensor. Its link stays in the hub.
    Pause = 1,
    /// Let the sensor stream again.
    Resume = 2,
    /// Restart the session with the scanner.
    Resync = 3,
    /// Return the background model.
    Show = 16,
    /// Discard the background model and learn it again.
    Reset = 17,
    /// Freeze the background model.
    Freeze = 18,
    /// Continue learning the background model.
    Thaw = 19,
    /// Use the ranges of the request as the background model.
    Load = 20,
}

impl Verb {
    /// Requests about the flow of data, in the order in which all commands print them.
    pub const FLOW: [Verb; 3] = [Verb::Pause, Verb::Resume, Verb::Resync];
    /// Requests about the background model, in the order in which all commands print them.
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

    /// Returns the verb with this name, or `None` if no verb has it.
    pub fn parse(name: &str) -> Option<Verb> {
        Verb::all().find(|verb| verb.name() == name)
    }
}

/// A request of a client. The request is encoded as the sensor's name (32 bytes), the verb (two bytes, little-endian),
/// six bytes of 0, and the model for [`Verb::Load`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Request {
    /// Name of the sensor.
    pub sensor: String,
    /// The command; `None` if this version does not have it, for example because the client is newer.
    pub verb: Option<Verb>,
    /// The model to load; `None` for every verb except [`Verb::Load`].
    pub model: Option<Box<Background>>,
}

impl Request {
    /// Creates the request `verb` for `sensor`, a name of at most 32 bytes.
    pub fn new(sensor: &str, verb: Verb) -> Request {
        Request { sensor: sensor.to_owned(), verb: Some(verb), model: None }
    }

    /// Creates the request that `sensor` use the ranges of `model` as its background.
    pub fn load(sensor: &str, model: &Background) -> Request {
        Request { model: Some(model.boxed()), ..Request::new(sensor, Verb::Load) }
    }

    /// Encodes the request.
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = vec![0; REQUEST_HEAD_LEN];
        text::write(&mut bytes[..SENSOR_NAME_LEN], &self.sensor);
        let verb = self.verb.map_or(0, |verb| verb as u16);
        bytes[SENSOR_NAME_LEN..SENSOR_NAME_LEN + 2].copy_from_slice(&verb.to_le_bytes());
        bytes.extend_from_slice(self.model.as_ref().map_or(&[], |model| model.bytes()));
        bytes
    }

    /// Decodes the request in `bytes`. Returns `None` if `bytes` are not a valid request.
    pub fn decode(bytes: &[u8]) -> Option<Request> {
        let (head, model) = bytes.split_at_checked(REQUEST_HEAD_LEN)?;
        let verb = u16::from_le_bytes([head[SENSOR_NAME_LEN], head[SENSOR_NAME_LEN + 1]]);
        Some(Request {
            sensor: text::read(&head[..SENSOR_NAME_LEN]).to_owned(),
            verb: Verb::all().find(|known| *known as u16 == verb),
            model: if model.is_empty() { None } else { Some(Background::read(model)?) },
        })
    }
}

/// A background model in a response.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ResponseModel {
    /// The current model of the sensor.
    pub model: Box<Background>,
    /// Time at which the hub saved the model that the next hub starts with, in ns since 1970; `None` if no model is
    /// saved.
    pub kept_wall_ns: Option<u64>,
}

impl From<Box<Background>> for ResponseModel {
    /// Wraps `model`, with no time of a saved model.
    fn from(model: Box<Background>) -> ResponseModel {
        ResponseModel { model, kept_wall_ns: None }
    }
}

/// A response: success, with a model if the request was for one, or a failure. The response is encoded as exit code and
/// message length (two bytes each, little-endian), then the message, then the model. The message of a failure has a
/// second line, which is the remedy. In a response with a model, the message is [`ResponseModel::kept_wall_ns`] in
/// decimal digits, or empty.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Response(pub Result<Option<ResponseModel>, Failure>);

impl Response {
    /// Maximum length in bytes of a response without a model. A longer message is truncated.
    pub const MAX_LEN: usize = 1024;

    /// Encodes the response.
    pub fn encode(&self) -> Vec<u8> {
        let (code, body) = match &self.0 {
            Ok(shown) => {
                let kept = shown.as_ref().and_then(|shown| shown.kept_wall_ns);
                (0, kept.map(|wall_ns| wall_ns.to_string()).unwrap_or_default())
            }
            Err(failure) => (failure.kind.exit_code(), format!("{}\n{}", failure.message, failure.hint)),
        };
        let mut message = vec![0; body.trim_end().len().min(Response::MAX_LEN - RESPONSE_HEAD_LEN)];
        text::write(&mut message, body.trim_end());
        let head = [u16::from(code), message.len() as u16].map(u16::to_le_bytes);
        let model = self.0.as_ref().ok().and_then(Option::as_ref);
        let model = model.map_or(&[][..], |shown| shown.model.bytes());
        [head.as_flattened(), &message, model].concat()
    }

    /// Decodes the response in `bytes`. Returns `None` if `bytes` are not a valid response. An unknown exit code
    /// becomes [`Kind::Failed`].
    pub fn decode(bytes: &[u8]) -> Option<Response> {
        let (&[code_low, code_high, low, high], rest) = bytes.split_first_chunk()?;
        let (message, model) = rest.split_at_checked(usize::from(u16::from_le_bytes([low, high])))?;
        let (message, code) = (text::read(message), u16::from_le_bytes([code_low, code_high]));
        if code == 0 {
            let kept_wall_ns = message.parse().ok();
            return Some(Response(Ok(match model {
                [] => None,
                model => Some(ResponseModel { model: Background::read(model)?, kept_wall_ns }),
            })));
        }
        let kind = RESPONSE_KINDS.into_iter().find(|kind| u16::from(kind.exit_code()) == code);
        let (message, hint) = message.split_once('\n').unwrap_or((message, ""));
        Some(Response(Err(Failure::new(kind.unwrap_or(Kind::Failed), message, hint))))
    }
}

/// Length in bytes of exit code and message length.
const RESPONSE_HEAD_LEN: usize = 4;

/// Length in bytes of the sensor's name in a request.
const SENSOR_NAME_LEN: usize = 32;
const REQUEST_HEAD_LEN: usize = 40;

/// The kinds of failure in responses. Each of these kinds has a different exit code.
const RESPONSE_KINDS: [Kind; 4] = [Kind::Failed, Kind::NoTopic, Kind::ResourceExhausted, Kind::Configuration];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::BackgroundHead;

    #[test]
    fn requests_round_trip() {
        for verb in Verb::all() {
            assert_eq!(Verb::parse(verb.name()), Some(verb));
            let request = Request::new("front", verb);
            assert_eq!(Request::decode(&request.encode()), Some(request));
        }
        let request = Request::load("front", &Background::of(BackgroundHead::default(), &[7; 8192]));
        let bytes = request.encode();
        assert_eq!(Request::decode(&bytes), Some(request));
        for cut in [0, 39, 41, bytes.len() - 1] {
            assert_eq!(Request::decode(&bytes[..cut]), None, "{cut}");
        }
        let mut unknown = Request::new("front", Verb::Pause).encode();
        unknown[32] = 99;
        let verb = Request::decode(&unknown).map(|request| request.verb);
        assert_eq!((verb, Verb::parse("stop")), (Some(None), None));
    }

    #[test]
    fn responses_round_trip() {
        let failure = |kind, hint: &str| Response(Err(Failure::new(kind, "front: no", hint)));
        let head = BackgroundHead { generation: 7, ..BackgroundHead::default() };
        let model = Background::of(head, &[0; 361]);
        for response in [
            Response(Ok(None)),
            Response(Ok(Some(model.clone().into()))),
            Response(Ok(Some(ResponseModel { model, kept_wall_ns: Some(u64::MAX) }))),
            failure(Kind::Failed, ""),
            failure(Kind::ResourceExhausted, "later"),
            failure(Kind::NoTopic, "a, b"),
        ] {
            assert_eq!(Response::decode(&response.encode()), Some(response));
        }
        let long = Response(Err(Failure::new(Kind::Failed, "é".repeat(2000), ""))).encode();
        assert!(long.len() <= Response::MAX_LEN && Response::decode(&long).is_some());
    }

    #[test]
    fn malformed_responses_decode_to_none() {
        for bytes in [&[][..], &[0, 0, 1], &[1, 0, 2, 0, b'a'], &[0, 0, 0, 0, 1]] {
            assert_eq!(Response::decode(bytes), None);
        }
        let unknown = Response::decode(&[200, 1, 1, 0, b'a']).unwrap();
        assert_eq!(unknown, Response(Err(Failure::new(Kind::Failed, "a", ""))));
    }
}
