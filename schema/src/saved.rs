//! A background model as one JSON object: the line that shows it, and the file that it is saved to and loaded from. Input
//! may come from anybody, so all of it is checked. Refuses to know where the text is stored.

use serde::{Deserialize, Serialize, Serializer};

use crate::{Background, Failure, Kind};

/// A model that was read, and its sensor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SavedModel {
    /// The sensor that it was saved from.
    pub sensor: String,
    /// The model, with the generation and flags that it had.
    pub model: Background,
}

/// Returns `model` of `sensor` as an object of class `background`: what [`SavedModel::parse`] reads. Angles are null as long as
/// there was no scan.
pub fn as_json<'a>(sensor: &'a str, model: &'a Background) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        class: &'static str,
        sensor: &'a str,
        generation: u32,
        taught: u16,
        unit_mm: u8,
        count: u16,
        first_angle_deg: Option<f64>,
        step_deg: Option<f64>,
        frozen: bool,
        #[serde(serialize_with = "known_ranges")]
        ranges: &'a [u16],
        #[serde(serialize_with = "far_beams")]
        far: &'a [u16],
    }
    let (first_angle_mdeg, step_mdeg) = model.angles_mdeg().unzip();
    Line {
        class: CLASS,
        sensor,
        generation: model.generation,
        taught: model.taught,
        unit_mm: model.unit_mm,
        count: model.count,
        first_angle_deg: first_angle_mdeg.map(|mdeg| f64::from(mdeg) / 1000.0),
        step_deg: step_mdeg.map(|mdeg| f64::from(mdeg) / 1000.0),
        frozen: model.is_frozen(),
        ranges: model.ranges(),
        far: model.ranges(),
    }
}

impl SavedModel {
    /// Returns the model in `text`, which was found at `place`. Keys that this program does not know are passed over.
    ///
    /// # Errors
    ///
    /// [`Kind::Configuration`] with place and reason if it is not a complete model: cut short, not JSON, of another class,
    /// or with numbers that are impossible or contradict each other.
    pub fn parse(text: &[u8], place: &str) -> Result<SavedModel, Failure> {
        let head: Head = read(text, place)?;
        if head.class != CLASS {
            return Err(broken(place, &format!("its class is {:?}, not {CLASS:?}", head.class)));
        }
        let file: File = read(text, place)?;
        file.model().map_err(|why| broken(place, &why)).map(|model| SavedModel { sensor: file.sensor, model })
    }
}

#[derive(Deserialize)]
struct Head {
    class: String,
}

/// Wider than what fits, so that a number that does not is named with its beam.
#[derive(Deserialize)]
struct File {
    sensor: String,
    generation: u32,
    taught: usize,
    unit_mm: u8,
    count: u16,
    first_angle_deg: f64,
    step_deg: f64,
    #[serde(default)]
    frozen: bool,
    ranges: Vec<Option<i64>>,
    far: Vec<usize>,
}

impl File {
    fn model(&self) -> Result<Background, String> {
        let File { generation, unit_mm, count, .. } = *self;
        let mut model = Background { generation, count, unit_mm, ..Background::default() };
        let Some((first_angle_mdeg, step_mdeg)) = model.angles_mdeg() else {
            return Err(format!("no sensor has {count} beams"));
        };
        let (first_angle_deg, step_deg) =
            (f64::from(first_angle_mdeg) / 1000.0, f64::from(step_mdeg) / 1000.0);
        if (self.first_angle_deg, self.step_deg) != (first_angle_deg, step_deg) {
            return Err(format!(
                "{count} beams start at {first_angle_deg} degrees in steps of {step_deg}, not at {} in steps of {}",
                self.first_angle_deg, self.step_deg
            ));
        }
        if ![1, 10, 100].contains(&unit_mm) {
            return Err(format!("unit_mm is {unit_mm}, and a unit is 1, 10 or 100 mm"));
        }
        if self.ranges.len() != usize::from(count) {
            return Err(format!("{} ranges of {count} beams", self.ranges.len()));
        }
        for (beam, (slot, range)) in model.range_array.iter_mut().zip(&self.ranges).enumerate() {
            let Some(range) = *range else { continue };
            *slot =
                u16::try_from(range).ok().filter(|range| (1..=LONGEST).contains(range)).ok_or_else(|| {
                    format!("the range of beam {beam} is {range}, and 1 to {LONGEST} are possible")
                })?;
        }
        for &beam in &self.far {
            match model.range_array[..usize::from(count)].get_mut(beam) {
                Some(slot @ &mut Background::UNTAUGHT) => *slot = Background::FAR,
                Some(_) => return Err(format!("beam {beam} is far twice, or has a range")),
                None => return Err(format!("beam {beam} is far, and there are {count}")),
            }
        }
        let taught = model.ranges().iter().filter(|&&range| range != Background::UNTAUGHT).count();
        if self.taught != taught {
            return Err(format!("taught is {}, and {taught} beams are", self.taught));
        }
        if taught == 0 {
            return Err("it knows no beam".to_owned());
        }
        (model.taught, model.flags) = (taught as u16, if self.frozen { Background::FROZEN } else { 0 });
        Ok(model)
    }
}

fn read<'a, T: Deserialize<'a>>(text: &'a [u8], place: &str) -> Result<T, Failure> {
    serde_json::from_slice(text).map_err(|error| {
        let text = text.trim_ascii();
        if text.is_empty() {
            return broken(place, "it is empty");
        }
        // In the middle of a number the end of the text is no other error than a wrong digit.
        let is_cut = error.is_eof() || text.starts_with(b"{") && !text.ends_with(b"}");
        broken(place, &if is_cut { format!("it is cut short: {error}") } else { error.to_string() })
    })
}

fn broken(place: &str, why: &str) -> Failure {
    let hint = "such a file is made by `scanhub background SENSOR save FILE`";
    Failure::new(Kind::Input, format!("{place} is no background model: {why}"), hint)
}

fn known_ranges<S: Serializer>(ranges: &[u16], serializer: S) -> Result<S::Ok, S::Error> {
    let is_known = |range: &u16| *range != Background::UNTAUGHT && *range != Background::FAR;
    serializer.collect_seq(ranges.iter().map(|range| Some(*range).filter(is_known)))
}

fn far_beams<S: Serializer>(ranges: &[u16], serializer: S) -> Result<S::Ok, S::Error> {
    let far = ranges.iter().enumerate().filter(|(_, range)| **range == Background::FAR);
    serializer.collect_seq(far.map(|(beam, _)| beam))
}

const CLASS: &str = "background";
/// The greatest reading of 15 bits that is no code.
const LONGEST: u16 = 0x7FFF - 9;

#[cfg(test)]
mod tests {
    use super::*;

    fn model(count: u16) -> Background {
        let mut model = Background { generation: 3, count, unit_mm: 10, ..Background::default() };
        model.range_array[..4].copy_from_slice(&[400, 0, Background::FAR, LONGEST]);
        model.taught = 3;
        model
    }

    fn text(model: &Background) -> String {
        serde_json::to_string(&as_json("front", model)).unwrap()
    }

    #[test]
    fn models_go_there_and_back() {
        for (count, unit_mm) in [(101, 1), (181, 10), (201, 100), (361, 1), (401, 10)] {
            for flags in [0, Background::FROZEN] {
                let model = Background { flags, unit_mm, ..model(count) };
                let saved = SavedModel { sensor: "front".into(), model };
                assert_eq!(SavedModel::parse(text(&model).as_bytes(), "m"), Ok(saved), "{count}");
            }
        }
        let begin =
            r#"{"class":"background","sensor":"front","generation":3,"taught":3,"unit_mm":10,"count":101,"#;
        let then =
            r#""first_angle_deg":40.0,"step_deg":1.0,"frozen":false,"ranges":[400,null,null,32758,null,"#;
        assert!(text(&model(101)).starts_with(&[begin, then].concat()));
        assert!(text(&model(101)).ends_with(r#"null],"far":[2]}"#));
        assert!(text(&Background::default()).contains(r#""first_angle_deg":null,"#), "before the first scan");
    }

    #[test]
    fn a_model_that_knows_nothing_is_none() {
        let empty = Background { count: 361, unit_mm: 1, ..Background::default() };
        let failure = SavedModel::parse(text(&empty).as_bytes(), "m").unwrap_err();
        let expected = "m is no background model: it knows no beam";
        assert_eq!((failure.kind, failure.message.as_str()), (Kind::Input, expected));
    }

    #[test]
    fn a_file_that_is_cut_short_anywhere_is_refused() {
        let whole = text(&model(361));
        for length in 0..whole.len() {
            let failure = SavedModel::parse(&whole.as_bytes()[..length], "/m.json").unwrap_err();
            assert_eq!(failure.kind, Kind::Input);
            let why = if length == 0 { "it is empty" } else { "it is cut short" };
            let expected = format!("/m.json is no background model: {why}");
            assert!(failure.message.starts_with(&expected), "{length}: {failure}");
        }
    }

    #[test]
    fn what_is_no_model_is_refused_with_the_reason() {
        let whole = text(&model(181));
        for (from, to, why) in [
            ("{", "no", "expected ident at line 1 column 2"),
            ("\"background\"", "\"scan\"", "its class is \"scan\", not \"background\""),
            ("\"class\"", "\"kind\"", "missing field `class`"),
            ("\"count\":181,", "", "missing field `count`"),
            ("\"count\":181", "\"count\":200", "no sensor has 200 beams"),
            (
                "\"count\":181",
                "\"count\":361",
                "361 beams start at 0 degrees in steps of 0.5, not at 0 in steps",
            ),
            ("\"step_deg\":1.0", "\"step_deg\":null", "invalid type: null, expected f64"),
            ("\"unit_mm\":10", "\"unit_mm\":2", "unit_mm is 2, and a unit is 1, 10 or 100 mm"),
            ("[400,", "[", "180 ranges of 181 beams"),
            ("[400", "[0", "the range of beam 0 is 0, and 1 to 32758 are possible"),
            ("32758", "65535", "the range of beam 3 is 65535"),
            ("[400", "[-1", "the range of beam 0 is -1"),
            ("[400", "[400.5", "invalid type: floating point `400.5`, expected i64"),
            ("[2]", "[181]", "beam 181 is far, and there are 181"),
            ("[2]", "[2,2]", "beam 2 is far twice, or has a range"),
            ("[2]", "[0]", "beam 0 is far twice, or has a range"),
            ("\"taught\":3", "\"taught\":4", "taught is 4, and 3 beams are"),
            ("[2]}", "[2]}{}", "trailing characters"),
        ] {
            assert!(whole.contains(from), "{from}");
            let failure = SavedModel::parse(whole.replacen(from, to, 1).as_bytes(), "m").unwrap_err();
            assert!(failure.message.contains(why), "{from} -> {to}: {failure}");
        }
        let newer = whole.replacen('{', "{\"noted\":[1],", 1);
        assert!(SavedModel::parse(newer.as_bytes(), "m").is_ok(), "a key that is not known yet");
    }
}
