//! The settings that a user requests of an LMS: which values exist, and which of them a type can have together.

use crate::line::family::Settings;
use crate::line::settings::{Key, Refusal, SettingsRequest, Value, refused};
use crate::lms::family::Family;
use crate::lms::variant::{Baud, Mode, Unit, Variant};

/// Sets a `key` that only an LMS has.
pub(crate) fn set(request: &mut SettingsRequest, key: Key, value: Value<'_>) -> Result<(), Refusal> {
    match (key, value) {
        (Key::Type, Value::Text(name)) => {
            let family = Family::of_name(name)
                .ok_or_else(|| refused(Key::Type, value, "lms200, lms211, lms221 or lms291"))?;
            request.expected_type = Some(family.name());
        }
        (Key::Angle, Value::Number(angle)) => {
            let known = Variant::ALL.map(|variant| variant.angle_deg);
            let known = known.into_iter().find(|&deg| f64::from(deg) == angle);
            request.angle_deg = Some(known.ok_or_else(|| refused(Key::Angle, value, "100 or 180"))?);
        }
        (Key::Resolution, Value::Number(step)) => {
            let known = Variant::ALL.map(|variant| variant.resolution_cdeg);
            let known = known.into_iter().find(|&cdeg| f64::from(cdeg) == step * 100.0);
            request.resolution_cdeg =
                Some(known.ok_or_else(|| refused(Key::Resolution, value, "0.25, 0.5 or 1"))?);
        }
        (Key::Unit, Value::Text("mm")) => request.unit_mm = Some(Unit::Mm.mm()),
        (Key::Unit, Value::Text("cm")) => request.unit_mm = Some(Unit::Cm.mm()),
        (Key::Unit, _) => return Err(refused(Key::Unit, value, "\"mm\" or \"cm\"")),
        (Key::Baud, Value::Whole(rate)) => {
            const REMEDY: &str =
                "500000, 38400, 19200 or 9600; it is of an LMS, and the rate of others is the model's";
            let known = u32::try_from(rate).ok().and_then(Baud::of_rate);
            request.baud = Some(known.ok_or_else(|| refused(Key::Baud, value, REMEDY))?.rate());
        }
        (Key::ModeNumber, _) => {
            let number = if let Value::Whole(number) = value { u8::try_from(number).ok() } else { None };
            let known = number.filter(|&number| Mode(number).has_ranges());
            request.mode_number = Some(known.ok_or_else(|| refused(Key::ModeNumber, value, MODES))?);
            request.mode = None;
        }
        _ => return Err(refused(key, value, "a value of another kind")),
    }
    Ok(())
}

/// Returns the settings of an LMS.
pub(crate) fn check(request: &SettingsRequest) -> Result<Settings, Refusal> {
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
    let family = request.expected_type.and_then(Family::of_name);
    let factory = family.and_then(Family::factory_variant).unwrap_or(Variant::HALF);
    let angle_deg = request.angle_deg.unwrap_or(factory.angle_deg);
    let resolution_cdeg = request.resolution_cdeg.unwrap_or(factory.resolution_cdeg);
    if family == Some(Family::Fast) {
        // A scan with 181 values looks like one of 180 degrees with a resolution of 1 degree.
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
    Ok(Settings {
        expected_type: request.expected_type,
        view: Some((angle_deg, resolution_cdeg)),
        baud: request.baud,
        unit_mm: request.unit_mm,
        mode_number: request.mode_number,
        ..Settings::default()
    })
}

/// Modes whose values are ranges (Telegram listing, 77h block D).
const MODES: &str = "0x00 to 0x06, or 0x0F: 0x01 has 3 reflector bits, 0x03 has 2, 0x05 has 1";
