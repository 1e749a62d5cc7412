//! SICK LMS 2xx: the framer, telegrams in both directions, and the session with a scanner. The simulator uses this
//! module too, so the module also decodes requests and encodes replies.
//!
//! This file has the settings and the recognizer of the family.

mod arrival_time;
pub mod command;
pub mod configuration;
pub mod explain;
pub mod framer;
pub mod header;
pub mod identity_probe;
pub mod lms_model;
pub mod measured;
pub mod operating;
mod protocol_state;
mod rate;
pub mod reply;
pub mod request_channel;
mod scan_schedule;
mod sensor;
pub mod session;
mod start;
pub mod status;
pub mod telegram;
pub mod variant;

use scanhub_schema::{ArrayFlags, Family, MICROS, MILLIS, Nanos, ScanHead};

use crate::line::family::{Evidence, Features, ListenStep, Model, RequestSteps, SearchSteps};
use crate::lms::framer::{FoundItem, Framer};
use crate::lms::header::{Reject, State};
use crate::lms::lms_model::LmsModel as Type;
use crate::lms::reply::Reply;
use crate::lms::telegram::MAX_TELEGRAM;
use crate::lms::variant::{Baud, MAX_BEAMS, Mode, Unit, Variant};
use crate::settings::{self, Key, Refusal, SettingsRequest, Value, refusal};

pub use arrival_time::WakeLead;
pub use identity_probe::IdentityProbe;
pub use protocol_state::SILENCE_TIMEOUT;
pub use sensor::{Notice, Problem, Sensor};
pub use session::{LmsSession, Settings};

/// Recognizer of LMS telegrams.
#[derive(Clone, Debug, Default)]
pub struct Probe {
    framer: Framer,
    is_found: bool,
    /// Whether the scanner has acknowledged the request, and no byte has arrived since then.
    is_acknowledged: bool,
}

impl Probe {
    fn check_bytes(&mut self) {
        while let Some(found) = self.framer.advance() {
            self.is_acknowledged = false;
            match found {
                FoundItem::Telegram(span) => {
                    self.is_found |= Reply::decode(self.framer.telegram_at(span).telegram).is_some();
                }
                FoundItem::Ack => self.is_acknowledged = true,
                FoundItem::Nak => {}
            }
        }
    }
}

impl crate::line::family::Probe for Probe {
    fn search_steps(&self) -> &'static SearchSteps {
        &SEARCH_STEPS
    }

    fn clear(&mut self) {
        *self = Probe::default();
    }

    fn expect_reply(&mut self, is_expected: bool) {
        self.framer.expect_acknowledge(is_expected);
        self.is_acknowledged = false;
    }

    fn receive(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.framer.read_buffer()[0] = *byte;
            self.framer.commit(1);
            self.is_acknowledged = false;
            self.check_bytes();
        }
    }

    fn hold_time(&self) -> Option<Nanos> {
        self.framer.hold_time()
    }

    fn release(&mut self, idle: Nanos) {
        self.framer.release(idle);
        self.check_bytes();
    }

    fn evidence(&self) -> Evidence {
        let is_begun = matches!(self.framer.state(), State::Body | State::Crc);
        if self.is_found {
            Evidence::Found(None)
        } else if is_begun || self.is_acknowledged {
            Evidence::Partial
        } else if self.framer.counters().rejected[Reject::Crc as usize] > 0 {
            Evidence::Damaged
        } else {
            Evidence::None
        }
    }
}

const SEARCH_STEPS: SearchSteps = SearchSteps {
    family: Family::Lms,
    // Only at this rate can several telegrams of a stream arrive in one listening step.
    listen_steps: &[ListenStep { rate: 500_000, duration: 120 * MILLIS, needs_bytes: true }],
    request_steps: Some(RequestSteps {
        // The rate after power-on, the rate at which an earlier hub may have left the scanner, and the other rates.
        rates: &[9_600, 500_000, 38_400, 19_200],
        settle_time: 20 * MILLIS,
        stop: None,
        requests: &[
            &[0x02, 0x00, 0x01, 0x00, command::TYPE, 0x1E, 0x12],
            &[0x02, 0x00, 0x01, 0x00, command::STATUS, 0x15, 0x12],
        ],
        // The scanner requires gaps of at least 55 us and at most 6 ms (Telegram listing 4.3). These limits leave time
        // for the write.
        gap: Some((120 * MICROS, 5 * MILLIS)),
        // The acknowledgement arrives within 60 ms (Telegram listing 4.3), and captured replies began within 150 ms.
        reply_timeout: 150 * MILLIS,
        extra_reply_time: 250 * MILLIS,
        // This time is sufficient for the rest of every captured reply, and for the rest of a status at 9,600 baud.
        extra_partial_time: 300 * MILLIS,
        repeats: 1,
    }),
    // The scanner starts at this rate, unless its EEPROM contains another rate (Telegram listing 7.1).
    boot_rate: Some(9_600),
    max_transmission: MAX_TELEGRAM,
    advice: "RS-422 needs jumper 7-8, and after power-on it takes up to a minute",
};

const _: () = assert!(Baud::ALL.len() == 4);

/// Models and settings of the family.
pub const FEATURES: Features = Features {
    models: &[],
    defaults: Model { name: "auto", baud: 500_000, beams: MAX_BEAMS },
    modes: &[],
    keys: &[Key::Type, Key::Angle, Key::Resolution, Key::Unit, Key::ModeNumber, Key::Baud],
    can_stop_motor: false,
    streams_unrequested: false,
    has_whole_telegrams: true,
    has_identity_probe: true,
    array_flags: ArrayFlags::UPPER,
    max_telegram: MAX_TELEGRAM,
};

/// Sets a `key` that only an LMS has.
pub(crate) fn set(request: &mut SettingsRequest, key: Key, value: Value<'_>) -> Result<(), Refusal> {
    match (key, value) {
        (Key::Type, Value::Text(name)) => {
            let family = Type::of_name(name)
                .ok_or_else(|| refusal(Key::Type, value, "lms200, lms211, lms221 or lms291"))?;
            request.expected_type = Some(family.name());
        }
        (Key::Angle, Value::Number(angle)) => {
            let known = Variant::ALL.map(|variant| variant.angle_deg);
            let known = known.into_iter().find(|&deg| f64::from(deg) == angle);
            request.angle_deg = Some(known.ok_or_else(|| refusal(Key::Angle, value, "100 or 180"))?);
        }
        (Key::Resolution, Value::Number(step)) => {
            let known = Variant::ALL.map(|variant| variant.resolution_cdeg);
            let known = known.into_iter().find(|&cdeg| f64::from(cdeg) == step * 100.0);
            request.resolution_cdeg =
                Some(known.ok_or_else(|| refusal(Key::Resolution, value, "0.25, 0.5 or 1"))?);
        }
        (Key::Unit, Value::Text("mm")) => request.unit_mm = Some(Unit::Mm.mm()),
        (Key::Unit, Value::Text("cm")) => request.unit_mm = Some(Unit::Cm.mm()),
        (Key::Unit, _) => return Err(refusal(Key::Unit, value, "\"mm\" or \"cm\"")),
        (Key::Baud, Value::Whole(rate)) => {
            const REMEDY: &str =
                "500000, 38400, 19200 or 9600; it is of an LMS, and the rate of others is the model's";
            let known = u32::try_from(rate).ok().and_then(Baud::of_rate);
            request.baud = Some(known.ok_or_else(|| refusal(Key::Baud, value, REMEDY))?.rate());
        }
        (Key::ModeNumber, _) => {
            let number = if let Value::Whole(number) = value { u8::try_from(number).ok() } else { None };
            let known = number.filter(|&number| Mode(number).has_ranges());
            request.mode_number = Some(known.ok_or_else(|| refusal(Key::ModeNumber, value, MODES))?);
            request.mode = None;
        }
        _ => return Err(refusal(key, value, "a value of another kind")),
    }
    Ok(())
}

/// Checks `request`, and returns the settings of a session with an LMS.
pub(crate) fn check(request: &SettingsRequest) -> Result<settings::Settings, Refusal> {
    if let Some(model) = &request.model {
        let what = format!("model = \"{model}\", but a scanner of family lms reports its model");
        return Err(Refusal::new(&[Key::Model], what, "leave it out; `type` is the expected model"));
    }
    if let Some(beams) = request.beams {
        let what = format!("beams = {beams}, and an lms has its own");
        return Err(Refusal::new(&[Key::Beams], what, "leave it out; `angle` and `resolution` say how many"));
    }
    if let Some(mode) = &request.mode {
        return Err(Refusal::new(&[Key::ModeName], format!("mode = \"{mode}\""), MODES));
    }
    let family = request.expected_type.and_then(Type::of_name);
    let factory = family.and_then(Type::factory_variant).unwrap_or(Variant::HALF);
    let angle_deg = request.angle_deg.unwrap_or(factory.angle_deg);
    let resolution_cdeg = request.resolution_cdeg.unwrap_or(factory.resolution_cdeg);
    if family == Some(Type::Fast) {
        // A scan of version S14 has 181 values, so it looks like a scan of 180 degrees with a resolution of 1 degree.
        let what = "the beams of version S14 have other angles: 90 degrees at 0.5, which no telegram reports";
        let remedy = "a hub can stream lms200, lms211, lms221 and lms291";
        return Err(Refusal::new(&[Key::Type], what.to_owned(), remedy));
    }
    let variant = Variant::new(angle_deg, resolution_cdeg).ok_or_else(|| {
        let step = f64::from(resolution_cdeg) / 100.0;
        let what = format!("no sensor scans {angle_deg} degrees at {step}");
        let remedy = "180 degrees at 0.5 or 1, 100 degrees at 0.25, 0.5 or 1";
        Refusal::new(&[Key::Resolution, Key::Angle, Key::Type], what, remedy)
    })?;
    if let Some((family, why)) = family.and_then(|family| Some((family, family.refuses_variant(variant)?))) {
        let what = format!("an {} does not scan {angle_deg} degrees: {why}", family.name());
        return Err(Refusal::new(&[Key::Angle, Key::Type], what, "angle = 100"));
    }
    Ok(settings::Settings { view: Some((angle_deg, resolution_cdeg)), ..request.unchecked_settings() })
}

/// List of the modes whose values are ranges, as text for the user (Telegram listing, 77h block D).
const MODES: &str = "0x00 to 0x06, or 0x0F: 0x01 has 3 reflector bits, 0x03 has 2, 0x05 has 1";

/// Returns the possible heads of scans whose angle and resolution are in `settings`. The measuring mode is still
/// unknown, so each head has the maximum number of range bits. If `settings` contain no unit, the result has one head
/// for each unit.
pub(crate) fn scan_heads(settings: &settings::Settings) -> Vec<ScanHead> {
    let variant = Settings::from(*settings).variant;
    let units = settings.unit_mm.map_or(vec![Unit::Mm.mm(), Unit::Cm.mm()], |mm| vec![mm]);
    let step_mdeg = u32::from(variant.resolution_cdeg) * 10;
    let (beams, first) = (variant.beams(), variant.first_angle_mdeg());
    let head = |mm: u8| ScanHead::lms(beams, first, step_mdeg, mm.into(), MAX_RANGE_BITS);
    units.into_iter().map(head).collect()
}

/// Number of range bits in the measuring mode with the most range bits (Telegram listing, 77h block D).
const MAX_RANGE_BITS: u8 = 15;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lms::command::Request;

    #[test]
    fn search_requests_type_and_status() {
        let steps = SEARCH_STEPS.request_steps.unwrap();
        assert_eq!(steps.requests[0], Request::Type.encode(0).bytes());
        assert_eq!(steps.requests[1], Request::Status.encode(0).bytes());
        assert!(steps.rates.iter().all(|&rate| Baud::of_rate(rate).is_some()));
    }
}
