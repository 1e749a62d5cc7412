//! CARMEN logs: text lines of which `FLASER n r1 .. rn ..` are scans in metres. They become the telegrams that an
//! LMS 2xx would have sent. Poses and all other lines are passed over.

use std::io::{self, BufRead, Read};

use lms::measured;
use lms::variant::{Mode, Unit, Variant};

use crate::Frame;

/// A scan of a log.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Sweep {
    /// Metres, from right to left.
    pub(crate) ranges_m: Vec<f64>,
    /// Seconds since 1970 (or since the log's start), where the line has its nine fields after the ranges.
    pub(crate) time_s: Option<f64>,
}

impl Sweep {
    /// The scan that `line` is. `Ok(None)` if it is another kind of line, `Err` with what is wrong with it.
    pub(crate) fn parse(line: &str) -> Result<Option<Sweep>, String> {
        let mut fields = line.split_ascii_whitespace();
        if fields.next() != Some("FLASER") {
            return Ok(None);
        }
        let count = fields.next().unwrap_or("");
        let count: usize = count.parse().map_err(|_| format!("{count:?} is not a number of beams"))?;
        if variant(count).is_none() {
            return Err(format!("{count} beams, which no LMS 2xx sends"));
        }
        let ranges_m = (0..count)
            .map(|beam| {
                let field = fields.next().ok_or_else(|| format!("{beam} ranges where it says {count}"))?;
                field.parse().map_err(|_| format!("range {field:?} is not a number"))
            })
            .collect::<Result<Vec<f64>, String>>()?;
        // Six numbers of pose, then the time, the host's name and the time in the log.
        let time_s = fields.nth(6).and_then(|time| time.parse().ok());
        Ok(Some(Sweep { ranges_m, time_s }))
    }

    /// The variant whose beams it has.
    pub(crate) fn variant(&self) -> Option<Variant> {
        variant(self.ranges_m.len())
    }

    /// The value words: `round(m * 1000 / unit_mm)`, [`BEYOND`] the range if too far, no return where the log has no
    /// number, and for the beam that logs of 180 and 360 beams leave out at the end.
    pub(crate) fn words(&self, unit: Unit, mode: Mode) -> Vec<u16> {
        let no_return = mode.max_value();
        let word = |&range_m: &f64| {
            if !range_m.is_finite() || range_m < 0.0 {
                return no_return;
            }
            let units = (range_m * 1000.0 / f64::from(unit.mm())).round();
            (units as u16).min(no_return - BEYOND)
        };
        let mut words: Vec<u16> = self.ranges_m.iter().map(word).collect();
        words.resize(self.variant().map_or(words.len(), Variant::beams), no_return);
        words
    }

    /// The telegram that a sensor with address 0 would have sent.
    pub(crate) fn frame(&self, unit: Unit, mode: Mode) -> Frame {
        let telegram = measured::encode(0, unit, &self.words(unit, mode), STATUS).bytes().to_vec();
        Frame { telegram, wall_ns: self.wall_ns(), header: None }
    }

    /// Its time in ns.
    pub(crate) fn wall_ns(&self) -> Option<u64> {
        self.time_s.filter(|time_s| *time_s > 0.0).map(|time_s| (time_s * 1e9) as u64)
    }
}

/// Whether `head`, the beginning of a file, looks like a log.
pub(crate) fn is_log(head: &[u8]) -> bool {
    head.split(|&byte| byte == b'\n').any(|line| {
        [&b"FLASER "[..], b"PARAM ", b"ODOM ", b"# message formats"].iter().any(|word| line.starts_with(word))
    })
}

/// Why there is no next scan.
#[derive(Debug)]
pub(crate) enum Wrong {
    /// What is wrong with the line.
    Line(String),
    /// The file cannot be read.
    File(io::Error),
}

/// The next scan of `reader` after line number `line`, which is counted on. A last line without its end that is no scan
/// is where the recording broke off, not a mistake.
pub(crate) fn next(reader: &mut impl BufRead, line: &mut u64) -> Result<Option<Sweep>, Wrong> {
    let mut bytes = Vec::new();
    loop {
        bytes.clear();
        if reader.take(LONGEST).read_until(b'\n', &mut bytes).map_err(Wrong::File)? == 0 {
            return Ok(None);
        }
        *line += 1;
        let is_last = bytes.last() != Some(&b'\n') && bytes.len() < LONGEST as usize;
        match Sweep::parse(&String::from_utf8_lossy(&bytes)) {
            Ok(None) => {}
            Err(_) if is_last => return Ok(None),
            Err(wrong) => return Err(Wrong::Line(wrong)),
            Ok(sweep) => return Ok(sweep),
        }
    }
}

/// The same of a log that was read before: lines that are wrong are passed over, where it breaks off it ends.
pub(crate) fn following(reader: &mut impl BufRead, line: &mut u64) -> Option<Sweep> {
    loop {
        match next(reader, line) {
            Ok(sweep) => return sweep,
            Err(Wrong::Line(_)) => {}
            Err(Wrong::File(_)) => return None,
        }
    }
}

fn variant(beams: usize) -> Option<Variant> {
    // 180 and 360: the last beam is missing.
    let whole = if matches!(beams, 180 | 360) { beams + 1 } else { beams };
    Variant::of_beams(whole)
}

/// What is subtracted from the greatest value for a range beyond the mode's (Telegram listing 10.8).
pub const BEYOND: u16 = 8;
/// No line is longer.
const LONGEST: u64 = 1 << 20;
/// Status byte of a healthy LMS type 6 (Telegram listing 8).
const STATUS: u8 = 0x10;

#[cfg(test)]
mod tests {
    use super::*;
    use lms::measured::Measured;
    use lms::telegram::Telegram;

    fn line(count: usize, range: &str) -> String {
        let ranges = vec![range; count].join(" ");
        format!("FLASER {count} {ranges} 1 2 3 4 5 6 1071078720.5 nohost 2.5\n")
    }

    #[test]
    fn a_scan_becomes_the_telegram_of_a_sensor() {
        let sweep = Sweep::parse(&line(180, "2.5")).unwrap().unwrap();
        assert_eq!(sweep.time_s, Some(1_071_078_720.5));
        let frame = sweep.frame(Unit::Mm, Mode(1));
        assert_eq!(frame.wall_ns, Some(1_071_078_720_500_000_000));
        let measured = Measured::decode(Telegram::check(&frame.telegram).unwrap()).unwrap();
        let words: Vec<u16> = measured.words().collect();
        assert_eq!((words.len(), words[0], words[179], words[180]), (181, 2500, 2500, 8191));
    }

    #[test]
    fn ranges_are_rounded_and_what_is_too_far_has_its_code() {
        let words = |range: &str, unit, mode| {
            Sweep::parse(&line(361, range)).unwrap().unwrap().words(unit, Mode(mode))[0]
        };
        assert_eq!(words("8.1824", Unit::Mm, 1), 8182);
        assert_eq!(words("8.1830", Unit::Mm, 1), 8183);
        assert_eq!(words("81.91", Unit::Mm, 1), 8183);
        assert_eq!(words("1e30", Unit::Mm, 4), 16375);
        assert_eq!(words("2.499", Unit::Cm, 1), 250);
        assert_eq!(words("nan", Unit::Cm, 1), 8191);
        assert_eq!(words("inf", Unit::Cm, 5), 32767);
        assert_eq!(words("-1", Unit::Cm, 1), 8191);
    }

    #[test]
    fn a_wrong_line_says_what_is_wrong() {
        assert_eq!(Sweep::parse("ODOM 1 2 3"), Ok(None));
        assert!(Sweep::parse("FLASER x").unwrap_err().contains("not a number of beams"));
        assert!(Sweep::parse("FLASER 17 1").unwrap_err().contains("17 beams"));
        assert!(Sweep::parse("FLASER 181 1 2").unwrap_err().contains("2 ranges"));
        assert!(Sweep::parse(&line(101, "2,5")).unwrap_err().contains("2,5"));
        assert_eq!(Sweep::parse(&line(101, "1").replace("1071078720.5", "x")).unwrap().unwrap().time_s, None);
    }
}
