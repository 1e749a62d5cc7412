//! A background model as one JSON object. Commands print the object as a line, save it to a file, and load it from a
//! file. The file may come from an untrusted source, so all of its values are checked.

use serde::{Deserialize, Serialize, Serializer};

use crate::{Background, BackgroundHead, Failure, Kind, MAX_BEAMS, in_degrees};

/// A model that was read from a file, with the name of its sensor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BackgroundFile {
    /// Name of the sensor that the model was saved from.
    pub sensor: String,
    /// The model. Its generation and flags are those at the time when it was saved.
    pub model: Box<Background>,
}

/// Returns `model` of `sensor` as a JSON object of class `background`, in the format that [`BackgroundFile::parse`]
/// reads. Angles are null before the first scan.
pub fn as_json<'a>(sensor: &'a str, model: &'a Background) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct BackgroundJson<'a> {
        class: &'static str,
        sensor: &'a str,
        generation: u32,
        known_beams: u16,
        #[serde(serialize_with = "unit_in_mm")]
        unit_mm: u32,
        count: u16,
        first_angle_deg: Option<f64>,
        step_deg: Option<f64>,
        frozen: bool,
        #[serde(serialize_with = "known_ranges")]
        ranges: &'a [u16],
        #[serde(serialize_with = "far_beams")]
        far: &'a [u16],
    }
    let in_degrees = |angle| (model.step != 0.0).then(|| in_degrees(angle));
    BackgroundJson {
        class: CLASS,
        sensor,
        generation: model.generation,
        known_beams: model.known_beams,
        unit_mm: model.unit_um,
        count: model.count,
        first_angle_deg: in_degrees(model.first_angle),
        step_deg: in_degrees(model.step),
        frozen: model.is_frozen(),
        ranges: model.ranges(),
        far: model.ranges(),
    }
}

impl BackgroundFile {
    /// Parses the model in `text`. `source` is the name of the file in messages. Unknown keys are ignored.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Input`] with `source` and the reason if `text` is not a complete model: it is truncated,
    /// not JSON, of another class, or has values that are out of range or contradict each other.
    pub fn parse(text: &[u8], source: &str) -> Result<BackgroundFile, Failure> {
        let head: ClassKey = read(text, source)?;
        if head.class != CLASS {
            return Err(invalid_file(source, &format!("its class is {:?}, not {CLASS:?}", head.class)));
        }
        let file: ParsedFile = read(text, source)?;
        file.model()
            .map_err(|reason| invalid_file(source, &reason))
            .map(|model| BackgroundFile { sensor: file.sensor, model })
    }
}

#[derive(Deserialize)]
struct ClassKey {
    class: String,
}

/// The JSON object before its values are checked. Ranges have a wider type than in a model. A range that is too large
/// for a model is therefore still parsed, and the message about it can name its beam.
#[derive(Deserialize)]
struct ParsedFile {
    sensor: String,
    generation: u32,
    known_beams: usize,
    unit_mm: f64,
    count: u16,
    first_angle_deg: f64,
    step_deg: f64,
    #[serde(default)]
    frozen: bool,
    ranges: Vec<Option<i64>>,
    far: Vec<usize>,
}

impl ParsedFile {
    fn model(&self) -> Result<Box<Background>, String> {
        let count = self.count;
        if !(1..=MAX_BEAMS).contains(&count.into()) {
            return Err(format!("it has {count} beams, and 1 to {MAX_BEAMS} are possible"));
        }
        let (first_angle_deg, step_deg) = (self.first_angle_deg, self.step_deg);
        if first_angle_deg.abs() > 360.0 || step_deg == 0.0 || step_deg.abs() > 360.0 {
            return Err(format!(
                "beams from {first_angle_deg} degrees in steps of {step_deg} are not possible"
            ));
        }
        let unit_um = (1000.0 * self.unit_mm).round();
        if !(1.0..=1e6).contains(&unit_um) {
            return Err(format!("unit_mm is {}, and 0.001 to 1000 are possible", self.unit_mm));
        }
        let first_angle_deg = first_angle_deg - if self.has_version_1_angles() { 90.0 } else { 0.0 };
        let mut model = Background::of(
            BackgroundHead {
                first_angle: first_angle_deg.to_radians(),
                step: step_deg.to_radians(),
                generation: self.generation,
                unit_um: unit_um as u32,
                flags: if self.frozen { Background::FROZEN } else { 0 },
                ..BackgroundHead::default()
            },
            &vec![Background::UNKNOWN; count.into()],
        );
        let slots = model.ranges_mut();
        if self.ranges.len() != usize::from(count) {
            return Err(format!("{} ranges of {count} beams", self.ranges.len()));
        }
        for (beam, (slot, range)) in slots.iter_mut().zip(&self.ranges).enumerate() {
            let Some(range) = *range else { continue };
            *slot = u16::try_from(range).ok().filter(|range| (1..=MAX_RANGE).contains(range)).ok_or_else(
                || format!("the range of beam {beam} is {range}, and 1 to {MAX_RANGE} are possible"),
            )?;
        }
        for &beam in &self.far {
            match slots.get_mut(beam) {
                Some(slot @ &mut Background::UNKNOWN) => *slot = Background::FAR,
                Some(_) => return Err(format!("beam {beam} is far twice, or has a range")),
                None => return Err(format!("beam {beam} is far, but there are only {count} beams")),
            }
        }
        let known_beams = model.ranges().iter().filter(|&&range| range != Background::UNKNOWN).count();
        if self.known_beams != known_beams {
            return Err(format!("known_beams is {}, but {known_beams} beams are known", self.known_beams));
        }
        if known_beams == 0 {
            return Err("the background of every beam is unknown".to_owned());
        }
        model.known_beams = known_beams as u16;
        Ok(model)
    }

    /// Returns whether the angles are in the frame of version 1, which supported only the LMS: 0 degrees was on the
    /// right, and 90 degrees was ahead.
    fn has_version_1_angles(&self) -> bool {
        let layouts =
            [(181, 0.0, 1.0), (361, 0.0, 0.5), (101, 40.0, 1.0), (201, 40.0, 0.5), (401, 40.0, 0.25)];
        layouts.contains(&(self.count, self.first_angle_deg, self.step_deg))
    }
}

fn read<'a, T: Deserialize<'a>>(text: &'a [u8], source: &str) -> Result<T, Failure> {
    serde_json::from_slice(text).map_err(|error| {
        let text = text.trim_ascii();
        if text.is_empty() {
            return invalid_file(source, "it is empty");
        }
        // A text that ends inside a number causes the same error as a wrong digit, so the last character is checked,
        // too.
        let is_cut = error.is_eof() || text.starts_with(b"{") && !text.ends_with(b"}");
        invalid_file(source, &if is_cut { format!("it is cut short: {error}") } else { error.to_string() })
    })
}

fn invalid_file(source: &str, reason: &str) -> Failure {
    let hint = "`scanhub background SENSOR save FILE` creates such a file";
    Failure::new(Kind::Input, format!("{source} is not a background model: {reason}"), hint)
}

/// Serializes a unit of `unit_um` micrometers in mm, as an integer if the unit is a whole number of mm.
///
/// # Errors
///
/// Returns the serializer's error.
pub fn unit_in_mm<S: Serializer>(unit_um: &u32, serializer: S) -> Result<S::Ok, S::Error> {
    match unit_um % 1000 {
        0 => serializer.serialize_u32(unit_um / 1000),
        _ => serializer.serialize_f64(f64::from(*unit_um) / 1000.0),
    }
}

fn known_ranges<S: Serializer>(ranges: &[u16], serializer: S) -> Result<S::Ok, S::Error> {
    let is_known = |range: &u16| *range != Background::UNKNOWN && *range != Background::FAR;
    serializer.collect_seq(ranges.iter().map(|range| Some(*range).filter(is_known)))
}

fn far_beams<S: Serializer>(ranges: &[u16], serializer: S) -> Result<S::Ok, S::Error> {
    let far = ranges.iter().enumerate().filter(|(_, range)| **range == Background::FAR);
    serializer.collect_seq(far.map(|(beam, _)| beam))
}

const CLASS: &str = "background";
/// Highest value that is a range in some family. In all families, all higher values are codes.
const MAX_RANGE: u16 = 0xFFEF;

#[cfg(test)]
mod tests {
    use super::*;

    fn model(count: u16, first_angle_deg: f64, step_deg: f64) -> Box<Background> {
        let mut ranges = vec![0; count.into()];
        ranges[..4].copy_from_slice(&[400, 0, Background::FAR, MAX_RANGE]);
        let head = BackgroundHead {
            first_angle: first_angle_deg.to_radians(),
            step: step_deg.to_radians(),
            generation: 3,
            known_beams: 3,
            unit_um: 10_000,
            ..BackgroundHead::default()
        };
        Background::of(head, &ranges)
    }

    /// Returns a model with beams as version 1 supported them. The angle of its first beam is in the frame of version
    /// 2.
    fn lms(count: u16) -> Box<Background> {
        match count {
            181 => model(181, -90.0, 1.0),
            361 => model(361, -90.0, 0.5),
            count => model(count, -50.0, 100.0 / f64::from(count - 1)),
        }
    }

    fn text(model: &Background) -> String {
        serde_json::to_string(&as_json("front", model)).unwrap()
    }

    #[test]
    fn background_round_trips_through_a_file() {
        for (count, unit_um) in [(101, 1_000), (181, 10_000), (201, 100_000), (361, 1_000), (401, 250)] {
            for flags in [0, Background::FROZEN] {
                let mut model = lms(count);
                (model.flags, model.unit_um) = (flags, unit_um);
                let text = text(&model);
                let saved = BackgroundFile { sensor: "front".into(), model };
                assert_eq!(BackgroundFile::parse(text.as_bytes(), "m"), Ok(saved), "{count}");
            }
        }
        let turning = model(450, 0.0, -0.8);
        assert_eq!(BackgroundFile::parse(text(&turning).as_bytes(), "m").unwrap().model, turning);
        let begin = r#"{"class":"background","sensor":"front","generation":3,"known_beams":3,"unit_mm":10,"count":101,"#;
        let then =
            r#""first_angle_deg":-50.0,"step_deg":1.0,"frozen":false,"ranges":[400,null,null,65519,null,"#;
        assert!(text(&lms(101)).starts_with(&[begin, then].concat()));
        assert!(text(&lms(101)).ends_with(r#"null],"far":[2]}"#));
        assert!(text(&Box::default()).contains(r#""first_angle_deg":null,"#), "before the first scan");
    }

    #[test]
    fn version_1_angles_are_converted() {
        for count in [101, 181, 201, 361, 401] {
            let before = text(&lms(count)).replace(":-90.0", ":0.0").replace(":-50.0", ":40.0");
            assert_eq!(BackgroundFile::parse(before.as_bytes(), "m").unwrap().model, lms(count), "{count}");
        }
    }

    #[test]
    fn empty_background_file_is_refused() {
        let mut empty = lms(361);
        empty.ranges_mut().fill(Background::UNKNOWN);
        empty.known_beams = 0;
        let failure = BackgroundFile::parse(text(&empty).as_bytes(), "m").unwrap_err();
        let expected = "m is not a background model: the background of every beam is unknown";
        assert_eq!((failure.kind, failure.message.as_str()), (Kind::Input, expected));
    }

    #[test]
    fn truncated_background_file_is_refused() {
        let whole = text(&lms(361));
        for length in 0..whole.len() {
            let failure = BackgroundFile::parse(&whole.as_bytes()[..length], "/m.json").unwrap_err();
            assert_eq!(failure.kind, Kind::Input);
            let why = if length == 0 { "it is empty" } else { "it is cut short" };
            let expected = format!("/m.json is not a background model: {why}");
            assert!(failure.message.starts_with(&expected), "{length}: {failure}");
        }
    }

    #[test]
    fn invalid_model_is_refused_with_the_reason() {
        let whole = text(&lms(181));
        for (from, to, why) in [
            ("{", "no", "expected ident at line 1 column 2"),
            ("\"background\"", "\"scan\"", "its class is \"scan\", not \"background\""),
            ("\"class\"", "\"kind\"", "missing field `class`"),
            ("\"count\":181,", "", "missing field `count`"),
            ("\"count\":181", "\"count\":9000", "it has 9000 beams, and 1 to 8192 are possible"),
            ("\"count\":181", "\"count\":361", "181 ranges of 361 beams"),
            ("\"step_deg\":1.0", "\"step_deg\":0", "beams from -90 degrees in steps of 0 are not possible"),
            ("\"step_deg\":1.0", "\"step_deg\":null", "invalid type: null, expected f64"),
            ("\"unit_mm\":10", "\"unit_mm\":0", "unit_mm is 0, and 0.001 to 1000 are possible"),
            ("[400,", "[", "180 ranges of 181 beams"),
            ("[400", "[0", "the range of beam 0 is 0, and 1 to 65519 are possible"),
            ("65519", "65535", "the range of beam 3 is 65535"),
            ("[400", "[-1", "the range of beam 0 is -1"),
            ("[400", "[400.5", "invalid type: floating point `400.5`, expected i64"),
            ("[2]", "[181]", "beam 181 is far, but there are only 181 beams"),
            ("[2]", "[2,2]", "beam 2 is far twice, or has a range"),
            ("[2]", "[0]", "beam 0 is far twice, or has a range"),
            ("\"known_beams\":3", "\"known_beams\":4", "known_beams is 4, but 3 beams are known"),
            ("[2]}", "[2]}{}", "trailing characters"),
        ] {
            assert!(whole.contains(from), "{from}");
            let failure = BackgroundFile::parse(whole.replacen(from, to, 1).as_bytes(), "m").unwrap_err();
            assert!(failure.message.contains(why), "{from} -> {to}: {failure}");
        }
        let newer = whole.replacen('{', "{\"noted\":[1],", 1);
        assert!(BackgroundFile::parse(newer.as_bytes(), "m").is_ok(), "a key that is not known yet");
    }
}
