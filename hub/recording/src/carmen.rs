//! CARMEN logs: text lines of which `FLASER n r1 .. rn ..`, `ROBOTLASER1` and `RAWLASER1` are scans in metres. They become
//! the telegrams that an LMS 2xx would have sent. Poses and all other lines are not read, but counted ([`Unread`]).

mod census;
mod log;

use std::fmt;

use lms::measured;
#[cfg(feature = "mcap")]
use lms::reply::Reply;
#[cfg(feature = "mcap")]
use lms::telegram::Telegram;
use lms::variant::{Unit, Variant};

use crate::{Encoding, Frame};
pub(crate) use census::Census;
pub use census::Unfit;
#[cfg(feature = "mcap")]
pub(crate) use log::line_of;
pub(crate) use log::{Log, Wrong, is_log};

/// A scan of a log.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Sweep {
    pub(crate) form: LineForm,
    /// Metres, from right to left.
    pub(crate) ranges_m: Vec<f64>,
    /// Nanoseconds since 1970 (or since the log's start), where the line has all its fields after the ranges.
    pub(crate) time_ns: Option<u64>,
    /// Whether the line has a pose other than 0.
    pub(crate) has_pose: bool,
    /// Whether the line has remissions.
    pub(crate) has_remissions: bool,
}

/// Data of a log that no other format holds, so that a conversion loses it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Unread {
    /// Scans with a pose other than 0.
    pub poses: u64,
    /// Lines of odometry.
    pub odometry: u64,
    /// Scans with remissions.
    pub remissions: u64,
    /// Other lines, except comments and empty ones.
    pub lines: u64,
}

/// How a scan is written. A log may have each scan in two of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum LineForm {
    /// `FLASER`: ranges, two poses, time.
    Flaser,
    /// `ROBOTLASER1`: seven fields of the sensor, ranges, remissions, two poses and five fields of the robot, time.
    RobotLaser,
    /// `RAWLASER1`: the same without what is of the robot.
    RawLaser,
}

/// Lists the counts that are not 0.
impl fmt::Display for Unread {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let parts = [
            (self.poses, "pose", "poses"),
            (self.odometry, "line of odometry", "lines of odometry"),
            (self.remissions, "scan's remissions", "scans' remissions"),
            (self.lines, "other line", "other lines"),
        ];
        let parts: Vec<String> = parts
            .into_iter()
            .filter(|(count, ..)| *count > 0)
            .map(|(count, one, many)| format!("{count} {}", if count == 1 { one } else { many }))
            .collect();
        f.write_str(&parts.join(", "))
    }
}

impl LineForm {
    fn of(word: &str) -> Option<LineForm> {
        Some(match word {
            "FLASER" => LineForm::Flaser,
            "ROBOTLASER1" => LineForm::RobotLaser,
            "RAWLASER1" => LineForm::RawLaser,
            _ => return None,
        })
    }
}

impl Sweep {
    /// The scan that `line` is. `Ok(None)` if it is another kind of line, `Err` with what is wrong with it.
    pub(crate) fn parse(line: &str) -> Result<Option<Sweep>, String> {
        let mut fields = line.split_ascii_whitespace();
        let Some(form) = fields.next().and_then(LineForm::of) else { return Ok(None) };
        // Type, start angle, field of view in radians, resolution, greatest range, accuracy, remission mode.
        let view = match form {
            LineForm::Flaser => None,
            LineForm::RobotLaser | LineForm::RawLaser => {
                let view: Option<f64> = fields.nth(2).and_then(|view| view.parse().ok());
                let _ = fields.nth(3);
                Some(view.ok_or("no field of view")?.to_degrees())
            }
        };
        let count = count(fields.next())?;
        let Some(variant) = variant(count) else {
            return Err(format!("{count} beams, which no LMS 2xx sends"));
        };
        if let Some(view_deg) = view.filter(|view| (view - f64::from(variant.angle_deg)).abs() > VIEW_DEG) {
            return Err(format!("{count} beams over {view_deg:.1} degrees, which no LMS 2xx sends"));
        }
        let ranges_m = (0..count)
            .map(|beam| {
                let field = fields.next().ok_or_else(|| format!("{beam} ranges instead of {count}"))?;
                field.parse().map_err(|_| format!("range {field:?} is not a number"))
            })
            .collect::<Result<Vec<f64>, String>>()?;
        // Before the time: two poses; remissions, two poses and five numbers; remissions.
        let (remissions, numbers) = match form {
            LineForm::Flaser => (Some(0), 6),
            LineForm::RobotLaser => (remissions(fields.next()), 11),
            LineForm::RawLaser => (remissions(fields.next()), 0),
        };
        let mut sweep =
            Sweep { form, ranges_m, time_ns: None, has_pose: false, has_remissions: remissions > Some(0) };
        let Some(remissions) = remissions else { return Ok(Some(sweep)) };
        let mut rest = fields.skip(remissions);
        let poses: Vec<&str> = rest.by_ref().take(numbers).take(POSES).collect();
        sweep.has_pose = poses.iter().any(|field| field.parse().is_ok_and(|number: f64| number != 0.0));
        sweep.time_ns = rest.nth(numbers.saturating_sub(POSES)).and_then(nanoseconds);
        Ok(Some(sweep))
    }

    /// The variant whose beams it has.
    pub(crate) fn variant(&self) -> Option<Variant> {
        variant(self.ranges_m.len())
    }

    /// The value words as `encoding` has them, in a log whose ranges are encoded as `own` says: a code of it stays that
    /// code. A range that does not go into `encoding` is rounded, or too far; what is no number is no return. The beam that
    /// logs of 180 and 360 beams leave out at the end is [`LEFT_OUT`].
    pub(crate) fn words(&self, own: Encoding, encoding: Encoding) -> Vec<u16> {
        let greatest = encoding.mode.max_value();
        let word = |&range_m: &f64| {
            if !range_m.is_finite() || range_m < 0.0 {
                return greatest;
            }
            match code(range_m, own) {
                Some(below_greatest) => greatest - below_greatest,
                None => (units(range_m, encoding.unit) as u16).min(greatest - BEYOND),
            }
        };
        let mut words: Vec<u16> = self.ranges_m.iter().map(word).collect();
        words.resize(self.variant().map_or(words.len(), Variant::beams), greatest - LEFT_OUT);
        words
    }

    /// The telegram that a sensor with address 0 would have sent; see [`words`](Self::words).
    pub(crate) fn frame(&self, own: Encoding, encoding: Encoding) -> Frame {
        let words = self.words(own, encoding);
        let telegram = measured::encode(0, encoding.unit, &words, STATUS).bytes().to_vec();
        Frame { telegram, wall_ns: self.time_ns, ..Frame::default() }
    }
}

/// Returns the nanoseconds in `text`, a number of seconds; `None` if it is not positive. A double has only a quarter of a
/// microsecond at today's times, so the decimals are read as they are.
fn nanoseconds(text: &str) -> Option<u64> {
    let (whole, fraction) = text.split_once('.').unwrap_or((text, ""));
    let is_digits = |text: &str| text.bytes().all(|byte| byte.is_ascii_digit());
    let ns = if !whole.is_empty() && is_digits(whole) && is_digits(fraction) {
        let decimals: u64 = format!("{fraction:0<9.9}").parse().ok()?;
        let rounded_up = fraction.as_bytes().get(9).is_some_and(|digit| *digit >= b'5');
        let seconds: u64 = whole.parse().ok()?;
        seconds.checked_mul(1_000_000_000)?.checked_add(decimals + u64::from(rounded_up))?
    } else {
        // Such as 1.07e9.
        text.parse().ok().map(|seconds: f64| (seconds * 1e9).round() as u64)?
    };
    (ns > 0).then_some(ns)
}

/// Returns whether `telegram` is the [`configuration`] reply that stands for the encoding of a log, and that no scanner sent.
#[cfg(feature = "mcap")]
pub(crate) fn is_made_up(telegram: &[u8]) -> bool {
    let reply = Telegram::check(telegram).and_then(Reply::decode);
    let Some(Reply::Configuration(reply)) = reply else { return false };
    reply.unit().is_some_and(|unit| configuration(Encoding { unit, mode: reply.mode() }) == telegram)
}

/// The reply in which a sensor says that its values are as `encoding` has them.
#[cfg(feature = "mcap")]
pub(crate) fn configuration(encoding: Encoding) -> Vec<u8> {
    lms::reply::configuration(0, encoding.mode, encoding.unit, STATUS).bytes().to_vec()
}

/// A range in whole units.
fn units(range_m: f64, unit: Unit) -> f64 {
    (range_m * 1000.0 / f64::from(unit.mm())).round()
}

/// How much less than the greatest value a range is, if so little that it is a code.
fn code(range_m: f64, encoding: Encoding) -> Option<u16> {
    let below = f64::from(encoding.mode.max_value()) - units(range_m, encoding.unit);
    (0.0..=f64::from(BEYOND)).contains(&below).then_some(below as u16)
}

fn count(field: Option<&str>) -> Result<usize, String> {
    let field = field.unwrap_or("");
    field.parse().map_err(|_| format!("{field:?} is not a number of beams"))
}

/// Remissions are as many as are said, which is none where there are none.
fn remissions(field: Option<&str>) -> Option<usize> {
    field?.parse().ok().filter(|count| *count < 10_000)
}

fn variant(beams: usize) -> Option<Variant> {
    // 180 and 360: the last beam is missing.
    let whole = if matches!(beams, 180 | 360) { beams + 1 } else { beams };
    Variant::of_beams(whole)
}

/// Numbers of two poses.
const POSES: usize = 6;
/// What is subtracted from the greatest value for a range beyond the mode's (Telegram listing 10.8).
pub const BEYOND: u16 = 8;
/// The same for the last beam of a scan that has none there: a code without a meaning, which no sensor sends.
pub(crate) const LEFT_OUT: u16 = 7;
/// Logs say the field of view with a step more or less.
const VIEW_DEG: f64 = 1.5;
/// Status byte of a healthy LMS type 6 (Telegram listing 8).
const STATUS: u8 = 0x10;

#[cfg(test)]
mod tests {
    use super::*;
    use lms::measured::Measured;
    use lms::telegram::Telegram;
    use lms::variant::Mode;

    fn line(count: usize, range: &str) -> String {
        let ranges = vec![range; count].join(" ");
        format!("FLASER {count} {ranges} 1 2 3 4 5 6 1071078720.5 nohost 2.5\n")
    }

    fn encoding(unit: Unit, mode: u8) -> Encoding {
        Encoding { unit, mode: Mode(mode) }
    }

    #[test]
    fn a_scan_becomes_the_telegram_of_a_sensor() {
        let sweep = Sweep::parse(&line(180, "2.5")).unwrap().unwrap();
        assert_eq!((sweep.time_ns, sweep.has_pose), (Some(1_071_078_720_500_000_000), true));
        let mm = encoding(Unit::Mm, 1);
        let frame = sweep.frame(mm, mm);
        assert_eq!(frame.wall_ns, Some(1_071_078_720_500_000_000));
        let measured = Measured::decode(Telegram::check(&frame.telegram).unwrap()).unwrap();
        let words: Vec<u16> = measured.words().collect();
        assert_eq!((words.len(), words[0], words[179], words[180]), (181, 2500, 2500, 8184));
    }

    #[test]
    fn ranges_are_rounded_and_what_is_too_far_has_its_code() {
        // Of a log that can say all of them.
        let word = |range: &str, unit, mode| {
            let sweep = Sweep::parse(&line(361, range)).unwrap().unwrap();
            sweep.words(encoding(Unit::Cm, 6), encoding(unit, mode))[0]
        };
        assert_eq!(word("8.1824", Unit::Mm, 1), 8182);
        assert_eq!(word("8.1830", Unit::Mm, 1), 8183);
        assert_eq!(word("81.91", Unit::Mm, 1), 8183);
        assert_eq!(word("1e30", Unit::Mm, 4), 16375);
        assert_eq!(word("2.499", Unit::Cm, 1), 250);
        assert_eq!(word("nan", Unit::Cm, 1), 8191);
        assert_eq!(word("inf", Unit::Cm, 5), 32767);
        assert_eq!(word("-1", Unit::Cm, 1), 8191);
    }

    #[test]
    fn a_code_stays_that_code_in_every_encoding() {
        let word =
            |range: &str, own, other| Sweep::parse(&line(181, range)).unwrap().unwrap().words(own, other)[7];
        let (cm, mm14, mm15) = (encoding(Unit::Cm, 0), encoding(Unit::Mm, 4), encoding(Unit::Mm, 6));
        for (range, code) in [("81.91", 0), ("81.90", 1), ("81.87", 4), ("81.83", 8)] {
            assert_eq!((word(range, cm, cm), word(range, cm, mm14)), (8191 - code, 16383 - code), "{range}");
        }
        assert_eq!(word("81.82", cm, cm), 8182);
        assert_eq!((word("16.383", mm14, mm14), word("16.374", mm14, mm14)), (16383, 16374));
        assert_eq!((word("32.763", mm15, mm15), word("32.763", mm15, cm)), (32763, 8187));
    }

    #[test]
    fn lines_of_later_logs_are_scans_too() {
        let sensor = "0 -1.570796 3.141593 0.008727 81.91 0.01 0";
        let ranges = vec!["2.5"; 361].join(" ");
        for line in [
            format!("ROBOTLASER1 {sensor} 361 {ranges} 2 7 8 1 2 3 1 2 3 0 0 0.1 0.2 0.3 12.25 host 1\n"),
            format!("RAWLASER1 {sensor} 361 {ranges} 0 12.25 host 1\n"),
        ] {
            let sweep = Sweep::parse(&line).unwrap().unwrap();
            assert_eq!(
                (sweep.ranges_m.len(), sweep.ranges_m[360], sweep.time_ns),
                (361, 2.5, Some(12_250_000_000)),
                "{line}"
            );
        }
        let wide = format!("RAWLASER1 {} 361 {ranges} 0 1 host 1", sensor.replace("3.141593", "4.18"));
        assert!(Sweep::parse(&wide).unwrap_err().contains("361 beams over 239.5 degrees"));
        assert!(Sweep::parse("ROBOTLASER1 0 1").unwrap_err().contains("no field of view"));
        assert_eq!(Sweep::parse("ROBOTLASER2 0 1"), Ok(None));
    }

    #[test]
    fn a_wrong_line_says_what_is_wrong() {
        assert_eq!(Sweep::parse("ODOM 1 2 3"), Ok(None));
        assert!(Sweep::parse("FLASER x").unwrap_err().contains("not a number of beams"));
        assert!(Sweep::parse("FLASER 17 1").unwrap_err().contains("17 beams"));
        assert!(Sweep::parse("FLASER 181 1 2").unwrap_err().contains("2 ranges"));
        assert!(Sweep::parse(&line(101, "2,5")).unwrap_err().contains("2,5"));
        assert_eq!(
            Sweep::parse(&line(101, "1").replace("1071078720.5", "x")).unwrap().unwrap().time_ns,
            None
        );
    }

    #[test]
    fn times_are_read_to_the_nanosecond() {
        for (text, ns) in [
            ("1071078720.123456", Some(1_071_078_720_123_456_000)),
            ("1071078720.999999999", Some(1_071_078_720_999_999_999)),
            ("1071078720.9999999995", Some(1_071_078_721_000_000_000)),
            ("1071078720.", Some(1_071_078_720_000_000_000)),
            ("7", Some(7_000_000_000)),
            ("1.5e3", Some(1_500_000_000_000)),
            ("0.000000", None),
            ("-1.5", None),
            ("nan", None),
            ("", None),
            ("99999999999999999999", None),
        ] {
            assert_eq!(nanoseconds(text), ns, "{text}");
        }
    }

    #[test]
    fn a_scan_says_whether_it_has_a_pose_and_remissions() {
        let has = |line: &str| {
            let sweep = Sweep::parse(line).unwrap().unwrap();
            (sweep.has_pose, sweep.has_remissions)
        };
        let ranges = vec!["2.5"; 181].join(" ");
        assert_eq!(has(&format!("FLASER 181 {ranges} 0 0.0 0 0 0 0 12.25 host 1")), (false, false));
        assert_eq!(has(&format!("FLASER 181 {ranges} 0 0 0 0 0 -0.1 12.25 host 1")), (true, false));
        let sensor = "0 -1.570796 3.141593 0.017453 81.91 0.01 0";
        let robot = |remissions: &str, poses: &str| {
            has(&format!("ROBOTLASER1 {sensor} 181 {ranges} {remissions} {poses} 1 2 3 4 5 12.25 host 1"))
        };
        assert_eq!(robot("2 7 8", "0 0 0 0 0 0"), (false, true), "speeds are no pose");
        assert_eq!(robot("0", "0 0 0 1 0 0"), (true, false));
        assert_eq!(has(&format!("RAWLASER1 {sensor} 181 {ranges} 1 9 12.25 host 1")), (false, true));
    }
}
