//! CARMEN logs: text files in which the lines `FLASER n r1 .. rn ..`, `ROBOTLASER1` and `RAWLASER1` are scans in
//! meters.
//!
//! [`LogReader`] reads the scans, [`RangeStats`] chooses the unit and the bits in which their ranges are whole values,
//! and [`LogScan::frame`] turns a scan into the telegram that an LMS 2xx would have sent. In the other direction,
//! [`scan_line`] writes a telegram as a line. Poses and all other lines are only counted ([`UnreadLines`]).

use std::fmt;
use std::io::{self, BufRead, Read};
use std::path::Path;

use scanhub_drivers::lms::measured;
#[cfg(feature = "mcap")]
use scanhub_drivers::lms::measured::MeasuredValues;
#[cfg(feature = "mcap")]
use scanhub_drivers::lms::reply::{self, Reply};
#[cfg(feature = "mcap")]
use scanhub_drivers::lms::telegram::Telegram;
use scanhub_drivers::lms::variant::{Mode, Unit, Variant};

use scanhub_schema::{Failure, Kind};

use crate::open::{is_truncation, unreadable};
use crate::{Contents, Encoding, Form, Frame};

/// A scan of a log.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct LogScan {
    pub(crate) form: LineForm,
    /// Ranges in meters, from right to left.
    pub(crate) ranges_m: Vec<f64>,
    /// Nanoseconds since 1970 (or since the log's start); `None` if the line lacks a field after the ranges.
    pub(crate) time_ns: Option<u64>,
    /// Whether the line has a pose other than 0.
    pub(crate) has_pose: bool,
    /// Whether the line has remissions.
    pub(crate) has_remissions: bool,
}

/// Counts of data that a conversion loses, because only a log can contain it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct UnreadLines {
    /// Number of scans with a pose other than 0.
    pub poses: u64,
    /// Number of lines of odometry.
    pub odometry: u64,
    /// Number of scans with remissions.
    pub remissions: u64,
    /// Number of other lines, except comments and empty lines.
    pub lines: u64,
}

/// Kind of line that contains a scan. A log may contain each scan twice, in two kinds of lines.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum LineForm {
    /// `FLASER`: ranges, two poses, time.
    Flaser,
    /// `ROBOTLASER1`: seven fields of the sensor, ranges, remissions, two poses and five fields of the robot, time.
    RobotLaser,
    /// `RAWLASER1`: seven fields of the sensor, ranges, remissions, time.
    RawLaser,
}

/// Lists the counts that are not 0.
impl fmt::Display for UnreadLines {
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

impl LogScan {
    /// Parses `line`. Returns `Ok(None)` if the line is not a scan.
    ///
    /// # Errors
    ///
    /// Returns a description of the mistake in the line.
    pub(crate) fn parse(line: &str) -> Result<Option<LogScan>, String> {
        let mut fields = line.split_ascii_whitespace();
        let Some(form) = fields.next().and_then(LineForm::of) else { return Ok(None) };
        // The seven fields of the sensor are type, start angle, field of view in radians, resolution, maximum range,
        // accuracy, and remission mode.
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
        if let Some(view_deg) =
            view.filter(|view| (view - f64::from(variant.angle_deg)).abs() > VIEW_TOLERANCE_DEG)
        {
            return Err(format!("{count} beams over {view_deg:.1} degrees, which no LMS 2xx sends"));
        }
        let ranges_m = (0..count)
            .map(|beam| {
                let field = fields.next().ok_or_else(|| format!("{beam} ranges instead of {count}"))?;
                field.parse().map_err(|_| format!("range {field:?} is not a number"))
            })
            .collect::<Result<Vec<f64>, String>>()?;
        // Between the ranges and the time, `FLASER` has two poses; `ROBOTLASER1` has remissions, two poses and five
        // numbers; and `RAWLASER1` has remissions.
        let (remissions, numbers) = match form {
            LineForm::Flaser => (Some(0), 6),
            LineForm::RobotLaser => (remissions(fields.next()), 11),
            LineForm::RawLaser => (remissions(fields.next()), 0),
        };
        let mut log_scan =
            LogScan { form, ranges_m, time_ns: None, has_pose: false, has_remissions: remissions > Some(0) };
        let Some(remissions) = remissions else { return Ok(Some(log_scan)) };
        let mut rest = fields.skip(remissions);
        let poses: Vec<&str> = rest.by_ref().take(numbers).take(POSE_FIELDS).collect();
        log_scan.has_pose = poses.iter().any(|field| field.parse().is_ok_and(|number: f64| number != 0.0));
        log_scan.time_ns = rest.nth(numbers.saturating_sub(POSE_FIELDS)).and_then(nanoseconds);
        Ok(Some(log_scan))
    }

    /// Returns the variant with this number of beams.
    pub(crate) fn variant(&self) -> Option<Variant> {
        variant(self.ranges_m.len())
    }

    /// Returns the ranges as value words in `encoding`. `own` is the encoding of the log. Codes keep their meaning. A
    /// range that is not a whole number of units is rounded, and a range that is too far for `encoding` becomes the
    /// code for a range beyond the maximum. NaN, infinite and negative ranges become "no return". Logs of 180 and 360
    /// beams lack the last beam, which becomes the code at [`MISSING_BEAM_OFFSET`].
    pub(crate) fn words(&self, own: Encoding, encoding: Encoding) -> Vec<u16> {
        let greatest = encoding.mode.max_value();
        let word = |&range_m: &f64| {
            if !range_m.is_finite() || range_m < 0.0 {
                return greatest;
            }
            match code(range_m, own) {
                Some(below_greatest) => greatest - below_greatest,
                None => (units(range_m, encoding.unit) as u16).min(greatest - BEYOND_RANGE_OFFSET),
            }
        };
        let mut words: Vec<u16> = self.ranges_m.iter().map(word).collect();
        words.resize(self.variant().map_or(words.len(), Variant::beams), greatest - MISSING_BEAM_OFFSET);
        words
    }

    /// Returns the telegram that a scanner with address 0 would have sent; see [`words`](Self::words).
    pub(crate) fn frame(&self, own: Encoding, encoding: Encoding) -> Frame {
        let words = self.words(own, encoding);
        let telegram = measured::encode(0, encoding.unit, &words, HEALTHY_STATUS).bytes().to_vec();
        Frame { telegram, wall_ns: self.time_ns, ..Frame::default() }
    }
}

/// Converts `text`, a number of seconds, to nanoseconds. Returns `None` if the number is not positive. For today's time
/// since 1970, a double has a resolution of only a quarter of a microsecond, so the digits before and after the point
/// are parsed as integers.
fn nanoseconds(text: &str) -> Option<u64> {
    let (integer, fraction) = text.split_once('.').unwrap_or((text, ""));
    let is_digits = |text: &str| text.bytes().all(|byte| byte.is_ascii_digit());
    let ns = if !integer.is_empty() && is_digits(integer) && is_digits(fraction) {
        let decimals: u64 = format!("{fraction:0<9.9}").parse().ok()?;
        let rounded_up = fraction.as_bytes().get(9).is_some_and(|digit| *digit >= b'5');
        let seconds: u64 = integer.parse().ok()?;
        seconds.checked_mul(1_000_000_000)?.checked_add(decimals + u64::from(rounded_up))?
    } else {
        // The number is written in another form, such as 1.07e9.
        text.parse().ok().map(|seconds: f64| (seconds * 1e9).round() as u64)?
    };
    (ns > 0).then_some(ns)
}

/// Returns whether `telegram` is the [`configuration`] reply that represents the encoding of a log. No scanner sent
/// this reply.
#[cfg(feature = "mcap")]
pub(crate) fn is_synthetic(telegram: &[u8]) -> bool {
    let reply = Telegram::check(telegram).and_then(Reply::decode);
    let Some(Reply::Configuration(reply)) = reply else { return false };
    reply.unit().is_some_and(|unit| configuration(Encoding { unit, mode: reply.mode() }) == telegram)
}

/// Returns the reply in which a scanner reports that its values have this encoding.
#[cfg(feature = "mcap")]
pub(crate) fn configuration(encoding: Encoding) -> Vec<u8> {
    reply::configuration_reply(0, encoding.mode, encoding.unit, HEALTHY_STATUS).bytes().to_vec()
}

/// Returns a range in whole units.
fn units(range_m: f64, unit: Unit) -> f64 {
    (range_m * 1000.0 / f64::from(unit.mm())).round()
}

/// Returns the offset of a range from the maximum value, if the offset is small enough for a code.
fn code(range_m: f64, encoding: Encoding) -> Option<u16> {
    let below = f64::from(encoding.mode.max_value()) - units(range_m, encoding.unit);
    (0.0..=f64::from(BEYOND_RANGE_OFFSET)).contains(&below).then_some(below as u16)
}

fn count(field: Option<&str>) -> Result<usize, String> {
    let field = field.unwrap_or("");
    field.parse().map_err(|_| format!("{field:?} is not a number of beams"))
}

/// Parses the field with the number of the remissions that follow.
fn remissions(field: Option<&str>) -> Option<usize> {
    field?.parse().ok().filter(|count| *count < 10_000)
}

fn variant(beams: usize) -> Option<Variant> {
    // Logs with 180 or 360 beams lack the last beam.
    let beam_count = if matches!(beams, 180 | 360) { beams + 1 } else { beams };
    Variant::of_beams(beam_count)
}

/// Reads the scans of a log in their order. If the log contains each scan in several kinds of lines, only the lines of
/// the first kind are used.
pub(crate) struct LogReader<R> {
    reader: R,
    /// Number of the last line that was read, from 1.
    pub(crate) line: u64,
    /// Kind of line of the first scan.
    form: Option<LineForm>,
    /// Encoding that a line of the log states, if any.
    pub(crate) stated_encoding: Option<Encoding>,
    /// Counts of the data so far that the scans do not contain.
    pub(crate) unread: UnreadLines,
}

/// Reason why no scan can be returned.
#[derive(Debug)]
pub(crate) enum LogError {
    /// The line is wrong, as described.
    Line(String),
    /// The file cannot be read.
    File(io::Error),
}

impl<R: BufRead> LogReader<R> {
    pub(crate) fn new(reader: R) -> Self {
        LogReader { reader, line: 0, form: None, stated_encoding: None, unread: UnreadLines::default() }
    }

    /// Returns the next scan; `None` at the end. A last line that has no line feed and is not a valid scan is not an
    /// error, because the recording broke off there.
    pub(crate) fn next(&mut self) -> Result<Option<LogScan>, LogError> {
        let mut bytes = Vec::new();
        loop {
            bytes.clear();
            if self
                .reader
                .by_ref()
                .take(MAX_LINE_LEN)
                .read_until(b'\n', &mut bytes)
                .map_err(LogError::File)?
                == 0
            {
                return Ok(None);
            }
            self.line += 1;
            let is_last = bytes.last() != Some(&b'\n') && bytes.len() < MAX_LINE_LEN as usize;
            let line = String::from_utf8_lossy(&bytes);
            if let Some(encoding) = parse_encoding_line(&line) {
                self.stated_encoding = self.stated_encoding.or(Some(encoding));
            }
            match LogScan::parse(&line) {
                Ok(None) => match line.split_ascii_whitespace().next() {
                    Some("ODOM") => self.unread.odometry += 1,
                    Some(word) if !word.starts_with('#') => self.unread.lines += 1,
                    _ => {}
                },
                Ok(Some(log_scan)) if *self.form.get_or_insert(log_scan.form) != log_scan.form => {
                    self.unread.lines += 1;
                }
                Ok(Some(log_scan)) => {
                    self.unread.poses += u64::from(log_scan.has_pose);
                    self.unread.remissions += u64::from(log_scan.has_remissions);
                    return Ok(Some(log_scan));
                }
                Err(_) if is_last => return Ok(None),
                Err(message) => return Err(LogError::Line(message)),
            }
        }
    }

    /// Returns the next scan of a log that was read before. Skips invalid lines. Returns `None` at the end, or if the
    /// file cannot be read.
    pub(crate) fn next_valid(&mut self) -> Option<LogScan> {
        loop {
            match self.next() {
                Ok(log_scan) => return log_scan,
                Err(LogError::Line(_)) => {}
                Err(LogError::File(_)) => return None,
            }
        }
    }
}

/// Returns the line in which a log states the encoding of its ranges. Other programs ignore this line.
#[cfg(feature = "mcap")]
pub(crate) fn encoding_line(encoding: Encoding) -> String {
    format!("{ENCODING_PREFIX} {} mm, {} bits\n", encoding.unit.mm(), encoding.mode.range_bits())
}

fn parse_encoding_line(line: &str) -> Option<Encoding> {
    let mut fields = line.strip_prefix(ENCODING_PREFIX)?.split([' ', ',']).filter(|field| !field.is_empty());
    let (mm, bits) = (fields.next()?, fields.nth(1)?);
    let unit = [Unit::Mm, Unit::Cm, Unit::Dm].into_iter().find(|unit| unit.mm().to_string() == mm)?;
    let mode = MODES.into_iter().find(|mode: &Mode| mode.range_bits().to_string() == bits)?;
    Some(Encoding { unit, mode })
}

/// Reads the log at `path` to its end, and returns its contents.
///
/// # Errors
///
/// Returns [`Kind::Input`] if the file cannot be read, or if no line of the file is a valid scan.
pub(crate) fn contents(path: &Path, reader: impl BufRead) -> Result<Contents, Failure> {
    let mut contents = Contents { form: Form::Carmen, ..Contents::default() };
    let (mut log, mut stats, mut refusal) = (LogReader::new(reader), RangeStats::default(), None);
    loop {
        match log.next() {
            Ok(Some(log_scan)) => {
                contents.note_scan(log_scan.variant(), log_scan.time_ns);
                stats.note(&log_scan.ranges_m);
            }
            Ok(None) => break,
            Err(LogError::File(error)) if is_truncation(&error) && contents.scans > 0 => {
                contents.damage.is_truncated = true;
                break;
            }
            Err(LogError::File(error)) => return Err(unreadable(path, &error)),
            Err(LogError::Line(message)) => {
                let message = format!("{}:{}: {message}", path.display(), log.line);
                let hint = "a scan is: FLASER 361 RANGE... in meters";
                refusal.get_or_insert(Failure::new(Kind::Input, message, hint));
                contents.damage.telegrams += 1;
                contents.damage.is_damaged = true;
            }
        }
    }
    contents.unread = log.unread;
    let (encoding, unencodable) = stats.encoding(log.stated_encoding);
    (contents.unit, contents.mode, contents.unencodable) =
        (Some(encoding.unit), Some(encoding.mode), unencodable);
    // If no line is a valid scan, the file has another format.
    match refusal.filter(|_| contents.scans == 0) {
        Some(refusal) => Err(refusal),
        None => Ok(contents),
    }
}

/// Returns whether `head`, the beginning of a file, looks like a log.
pub(crate) fn is_log(head: &[u8]) -> bool {
    head.split(|&byte| byte == b'\n').any(|line| FIRST_WORDS.iter().any(|word| line.starts_with(word)))
}

/// Statistics of the ranges of a log, from which the encoding of the ranges is chosen. In a log, a code of the scanner
/// is one of the largest ranges that the encoding can hold.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct RangeStats {
    /// Number of ranges that are not whole centimeters, and number of ranges that are not whole millimeters.
    inexact: [u64; 2],
    /// Longest range of the log. Ranges that no value can hold are ignored.
    max_range_m: f64,
    /// Number of ranges that no value can hold.
    unencodable: u64,
}

/// Counts of the ranges of a log that do not fit into a single encoding of an LMS 2xx.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct UnencodableRanges {
    /// Number of ranges that are rounded.
    pub rounded: u64,
    /// Number of ranges that are too far for any value.
    pub beyond: u64,
}

impl RangeStats {
    /// Counts a scan.
    pub(crate) fn note(&mut self, ranges_m: &[f64]) {
        for &range_m in ranges_m.iter().filter(|range_m| range_m.is_finite() && **range_m >= 0.0) {
            if units(range_m, COARSEST_ENCODING.unit) > f64::from(COARSEST_ENCODING.mode.max_value()) {
                self.unencodable += 1;
                continue;
            }
            self.max_range_m = self.max_range_m.max(range_m);
            for (finer, unit) in self.inexact.iter_mut().zip([Unit::Cm, Unit::Mm]) {
                let range = range_m * 1000.0 / f64::from(unit.mm());
                *finer += u64::from((range - range.round()).abs() > UNIT_TOLERANCE);
            }
        }
    }

    /// Chooses the encoding of the log, and counts the ranges that do not fit into this encoding. If all ranges fit
    /// into the encoding that the log states itself (`stated`), that encoding is chosen. Otherwise, the unit is
    /// centimeters if all ranges are whole centimeters, and millimeters if not. The encoding has as few bits as the
    /// longest range needs.
    pub(crate) fn encoding(&self, stated: Option<Encoding>) -> (Encoding, UnencodableRanges) {
        let order = if self.inexact[0] == 0 { [Unit::Cm, Unit::Mm] } else { [Unit::Mm, Unit::Cm] };
        let of_unit = |unit: Unit| MODES.map(|mode| Encoding { unit, mode });
        let all = stated.into_iter().chain(order.into_iter().flat_map(of_unit));
        let fits = |encoding: &Encoding| self.reaches(*encoding) && self.is_whole(encoding.unit);
        let encoding = all.clone().find(fits).or_else(|| all.clone().find(|it| self.reaches(*it)));
        let encoding = encoding.unwrap_or(COARSEST_ENCODING);
        let rounded = self.inexact[usize::from(encoding.unit == Unit::Mm)];
        (encoding, UnencodableRanges { rounded, beyond: self.unencodable })
    }

    fn reaches(&self, encoding: Encoding) -> bool {
        units(self.max_range_m, encoding.unit) <= f64::from(encoding.mode.max_value())
    }

    fn is_whole(&self, unit: Unit) -> bool {
        match unit {
            Unit::Cm => self.inexact[0] == 0,
            Unit::Mm => self.inexact[1] == 0,
            // Only a log that itself states the unit has ranges in decimeters, so inexact decimeters are not counted.
            Unit::Dm => true,
        }
    }
}

impl UnencodableRanges {
    /// Returns whether all ranges can be encoded.
    pub fn is_none(&self) -> bool {
        *self == UnencodableRanges::default()
    }
}

/// Lists the counts that are not 0.
impl fmt::Display for UnencodableRanges {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let counted = |count: u64, what: &str| (count > 0).then(|| format!("{count} {what}"));
        let parts = [
            counted(self.rounded, "ranges are finer than the unit in which an LMS 2xx reaches that far"),
            counted(self.beyond, "ranges are too long for a value of an LMS 2xx"),
        ];
        f.write_str(&parts.into_iter().flatten().collect::<Vec<_>>().join(", "))
    }
}

#[cfg(feature = "mcap")]
/// Returns the line of a scan at `at_ns` since 1970, in a log that begins at `first_ns`; `None` if `telegram` is not a
/// whole scan. A code is written as the range that its value would mean, as in logs of the scanner. Reflector levels,
/// field bits, address and status are lost.
pub(crate) fn scan_line(telegram: &[u8], mode: Mode, at_ns: u64, first_ns: u64) -> Option<String> {
    let measured = MeasuredValues::decode(Telegram::check(telegram)?)?;
    if measured.partial().is_some() || Variant::of_beams(measured.count()).is_none() {
        return None;
    }
    let (greatest, unit) = (mode.max_value(), measured.unit());
    let decimals = match unit {
        Unit::Mm => 3,
        Unit::Cm => 2,
        Unit::Dm => 1,
    };
    let ranges: Vec<u16> = measured.words().map(|word| word & greatest).collect();
    let ranges = match &ranges[..] {
        // The scan comes from a log that lacked the last beam, so the new log omits the beam, too.
        [ranges @ .., last]
            if *last == greatest - MISSING_BEAM_OFFSET && matches!(ranges.len(), 180 | 360) =>
        {
            ranges
        }
        ranges => ranges,
    };
    let mut line = format!("FLASER {}", ranges.len());
    for &range in ranges {
        line += &format!(" {:.decimals$}", f64::from(range) * f64::from(unit.mm()) / 1000.0);
    }
    // Subtract the rounded times, so that the difference stays the same if the new log is converted and written again.
    let micros = |ns: u64| ns.saturating_add(500) / 1000;
    let seconds = |micros: u64| format!("{}.{:06}", micros / 1_000_000, micros % 1_000_000);
    let (at, since) = (micros(at_ns), micros(at_ns).saturating_sub(micros(first_ns)));
    line += &format!(" 0 0 0 0 0 0 {} scanhub {}\n", seconds(at), seconds(since));
    Some(line)
}

/// First words of the lines at the beginning of a log.
const FIRST_WORDS: [&[u8]; 6] =
    [b"FLASER ", b"ROBOTLASER1 ", b"RAWLASER1 ", b"PARAM ", b"ODOM ", b"# message formats"];
/// Beginning of the line that names the encoding of the ranges.
const ENCODING_PREFIX: &str = "# LMS 2xx values:";
/// Maximum length of a line in bytes.
const MAX_LINE_LEN: u64 = 1 << 20;
/// Measuring modes without reflector levels, by the bits of a range: 13, 14, 15.
const MODES: [Mode; 3] = [Mode(0x00), Mode(0x04), Mode(0x06)];
/// Encoding with the longest maximum range.
const COARSEST_ENCODING: Encoding = Encoding { unit: Unit::Cm, mode: Mode(0x06) };
/// Tolerance for a whole number of units. The text has the exact value, and the error of a double is smaller than this
/// tolerance.
const UNIT_TOLERANCE: f64 = 1e-6;
/// Number of fields of two poses.
const POSE_FIELDS: usize = 6;
/// Offset of a code from the maximum value: the code means that the range is beyond the maximum of the mode (Telegram
/// listing 10.8).
pub const BEYOND_RANGE_OFFSET: u16 = 8;
/// Offset of a code from the maximum value: the code stands for a last beam that the log lacks. For a scanner, this
/// code has no meaning, and no scanner sends it.
pub(crate) const MISSING_BEAM_OFFSET: u16 = 7;
/// Tolerance of the field of view, in degrees. Logs round the field of view to a step more or less.
const VIEW_TOLERANCE_DEG: f64 = 1.5;
/// Status byte of a healthy LMS type 6 (Telegram listing 8).
const HEALTHY_STATUS: u8 = 0x10;

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_drivers::lms::measured::MeasuredValues;
    use scanhub_drivers::lms::telegram::Telegram;
    use scanhub_drivers::lms::variant::Mode;

    fn line(count: usize, range: &str) -> String {
        let ranges = vec![range; count].join(" ");
        format!("FLASER {count} {ranges} 1 2 3 4 5 6 1071078720.5 nohost 2.5\n")
    }

    fn encoding(unit: Unit, mode: u8) -> Encoding {
        Encoding { unit, mode: Mode(mode) }
    }

    #[test]
    fn scan_becomes_the_telegram_of_a_sensor() {
        let log_scan = LogScan::parse(&line(180, "2.5")).unwrap().unwrap();
        assert_eq!((log_scan.time_ns, log_scan.has_pose), (Some(1_071_078_720_500_000_000), true));
        let mm = encoding(Unit::Mm, 1);
        let frame = log_scan.frame(mm, mm);
        assert_eq!(frame.wall_ns, Some(1_071_078_720_500_000_000));
        let measured = MeasuredValues::decode(Telegram::check(&frame.telegram).unwrap()).unwrap();
        let words: Vec<u16> = measured.words().collect();
        assert_eq!((words.len(), words[0], words[179], words[180]), (181, 2500, 2500, 8184));
    }

    #[test]
    fn rounds_ranges_and_encodes_too_far_ones_as_codes() {
        // The encoding of the log can hold all of these ranges.
        let word = |range: &str, unit, mode| {
            let log_scan = LogScan::parse(&line(361, range)).unwrap().unwrap();
            log_scan.words(encoding(Unit::Cm, 6), encoding(unit, mode))[0]
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
    fn range_code_is_kept_in_every_encoding() {
        let word = |range: &str, own, other| {
            LogScan::parse(&line(181, range)).unwrap().unwrap().words(own, other)[7]
        };
        let (cm, mm14, mm15) = (encoding(Unit::Cm, 0), encoding(Unit::Mm, 4), encoding(Unit::Mm, 6));
        for (range, code) in [("81.91", 0), ("81.90", 1), ("81.87", 4), ("81.83", 8)] {
            assert_eq!((word(range, cm, cm), word(range, cm, mm14)), (8191 - code, 16383 - code), "{range}");
        }
        assert_eq!(word("81.82", cm, cm), 8182);
        assert_eq!((word("16.383", mm14, mm14), word("16.374", mm14, mm14)), (16383, 16374));
        assert_eq!((word("32.763", mm15, mm15), word("32.763", mm15, cm)), (32763, 8187));
    }

    #[test]
    fn lines_of_newer_logs_are_scans() {
        let sensor = "0 -1.570796 3.141593 0.008727 81.91 0.01 0";
        let ranges = vec!["2.5"; 361].join(" ");
        for line in [
            format!("ROBOTLASER1 {sensor} 361 {ranges} 2 7 8 1 2 3 1 2 3 0 0 0.1 0.2 0.3 12.25 host 1\n"),
            format!("RAWLASER1 {sensor} 361 {ranges} 0 12.25 host 1\n"),
        ] {
            let log_scan = LogScan::parse(&line).unwrap().unwrap();
            assert_eq!(
                (log_scan.ranges_m.len(), log_scan.ranges_m[360], log_scan.time_ns),
                (361, 2.5, Some(12_250_000_000)),
                "{line}"
            );
        }
        let wide = format!("RAWLASER1 {} 361 {ranges} 0 1 host 1", sensor.replace("3.141593", "4.18"));
        assert!(LogScan::parse(&wide).unwrap_err().contains("361 beams over 239.5 degrees"));
        assert!(LogScan::parse("ROBOTLASER1 0 1").unwrap_err().contains("no field of view"));
        assert_eq!(LogScan::parse("ROBOTLASER2 0 1"), Ok(None));
    }

    #[test]
    fn malformed_line_error_names_the_cause() {
        assert_eq!(LogScan::parse("ODOM 1 2 3"), Ok(None));
        assert!(LogScan::parse("FLASER x").unwrap_err().contains("not a number of beams"));
        assert!(LogScan::parse("FLASER 17 1").unwrap_err().contains("17 beams"));
        assert!(LogScan::parse("FLASER 181 1 2").unwrap_err().contains("2 ranges"));
        assert!(LogScan::parse(&line(101, "2,5")).unwrap_err().contains("2,5"));
        assert_eq!(
            LogScan::parse(&line(101, "1").replace("1071078720.5", "x")).unwrap().unwrap().time_ns,
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
    fn detects_pose_and_remissions_of_a_log_scan() {
        let has = |line: &str| {
            let log_scan = LogScan::parse(line).unwrap().unwrap();
            (log_scan.has_pose, log_scan.has_remissions)
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

    fn chosen(ranges_m: &[f64], stated: Option<Encoding>) -> (u8, u8, UnencodableRanges) {
        let mut stats = RangeStats::default();
        stats.note(ranges_m);
        let (encoding, unencodable) = stats.encoding(stated);
        (encoding.unit.mm(), encoding.mode.range_bits(), unencodable)
    }

    #[test]
    fn chooses_lossless_unit_and_bits() {
        let none = UnencodableRanges::default();
        assert_eq!(chosen(&[], None), (10, 13, none));
        assert_eq!(chosen(&[20.0, 0.01, 81.91, f64::NAN, -1.0], None), (10, 13, none));
        assert_eq!(chosen(&[81.92], None), (10, 14, none));
        assert_eq!(chosen(&[163.84], None), (10, 15, none));
        assert_eq!(chosen(&[1.234, 8.191], None), (1, 13, none));
        assert_eq!(chosen(&[1.234, 16.383], None), (1, 14, none));
        assert_eq!(chosen(&[1.234, 16.384], None), (1, 15, none));
        assert_eq!(chosen(&[32.767, 32.763], None), (1, 15, none));
    }

    #[test]
    fn counts_ranges_that_cannot_be_encoded() {
        assert_eq!(chosen(&[1.234, 2.0, 81.91], None), (10, 13, UnencodableRanges { rounded: 1, beyond: 0 }));
        assert_eq!(
            chosen(&[1.23456, 9.0, 9.001], None),
            (1, 14, UnencodableRanges { rounded: 1, beyond: 0 })
        );
        assert_eq!(chosen(&[1.5, 1e30, 1000.0], None), (10, 13, UnencodableRanges { rounded: 0, beyond: 2 }));
        let unencodable = UnencodableRanges { rounded: 2, beyond: 1 };
        assert!(
            unencodable.to_string().contains("2 ranges are finer")
                && unencodable.to_string().contains("1 ranges are too long")
        );
    }

    #[test]
    fn uses_the_encoding_of_the_log_if_possible() {
        let mm = |mode| Some(Encoding { unit: Unit::Mm, mode: Mode(mode) });
        assert_eq!(chosen(&[8.185], mm(0x04)), (1, 14, UnencodableRanges::default()));
        assert_eq!(chosen(&[8.185], None), (1, 13, UnencodableRanges::default()));
        assert_eq!(chosen(&[20.0], mm(0x04)), (10, 13, UnencodableRanges::default()));
        assert_eq!(
            chosen(&[1.234], Some(Encoding { unit: Unit::Cm, mode: Mode(0) })),
            (1, 13, UnencodableRanges::default())
        );
    }

    #[cfg(feature = "mcap")]
    #[test]
    fn written_line_is_read_back() {
        let mut words = vec![1234; 181];
        (words[0], words[1], words[2]) = (0xE000 | 500, 8191, 8183);
        let telegram = measured::encode(0, Unit::Cm, &words, 0x10);
        let line = scan_line(telegram.bytes(), Mode(1), 1_071_078_720_123_456_789, 1_071_078_720_000_000_000)
            .unwrap();
        assert!(line.ends_with(" 12.34 0 0 0 0 0 0 1071078720.123457 scanhub 0.123457\n"), "{line}");
        // The log has the difference of the rounded times: 123 457 - 100 000 microseconds.
        let first = 1_071_078_720_000_000_000 + 100_000_400;
        let again = scan_line(telegram.bytes(), Mode(1), 1_071_078_720_123_456_500, first).unwrap();
        assert!(again.ends_with(" scanhub 0.023457\n"), "{again}");
        let log_scan = LogScan::parse(&line).unwrap().unwrap();
        assert_eq!(log_scan.ranges_m[..4], [5.0, 81.91, 81.83, 12.34]);
        let cm = Encoding { unit: Unit::Cm, mode: Mode(0) };
        assert_eq!(log_scan.words(cm, cm)[..4], [500, 8191, 8183, 1234]);
        words[180] = 8191 - MISSING_BEAM_OFFSET;
        let line = scan_line(measured::encode(0, Unit::Cm, &words, 0x10).bytes(), Mode(1), 1, 1).unwrap();
        assert!(line.starts_with("FLASER 180 5.00 81.91 81.83 12.34"), "{line}");
    }

    #[cfg(feature = "mcap")]
    #[test]
    fn partial_scans_and_replies_have_no_log_line() {
        assert_eq!(scan_line(reply::mode_reply(0, true, 0x10).bytes(), Mode(0), 1, 0), None);
        let part = measured::encode(0, Unit::Cm, &[7; 61], 0x10);
        assert_eq!(scan_line(part.bytes(), Mode(0), 1, 0), None);
    }
}
