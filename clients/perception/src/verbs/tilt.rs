//! `scanhub tilt`: three dimensions of a scanner on a mount, as lines and as topics. Refuses to know how points and obstacles
//! are found.

mod check;
mod lines;
mod publish;

use std::io::Write;
use std::rc::Rc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use crate::tilt::{Angle, Check, Mount, Settings, Sweep, Tilting, Withheld};
use publish::Samples;
use scanhub_client::streams::Sample;
use scanhub_schema::{Failure, Kind, Topic};
use scanhub_shm::Domain;

use scanhub_verbs::follow::ReceiveStats;
use scanhub_verbs::follow::{Bounds, Notice, Sink, follow};
use scanhub_verbs::names::TopicName;
use scanhub_verbs::output::{End, Output, quiet};
use scanhub_verbs::{json, text};

/// What `tilt` is asked for.
#[derive(Clone, Debug)]
pub struct TiltOptions {
    /// The scanner.
    pub sensor: String,
    /// The name under which the angles of its mount are published.
    pub angles: String,
    /// The name that its topics are published under; none: it publishes nothing.
    pub name: Option<String>,
    /// Where the axis is, and the scanner on it.
    pub mount: Mount,
    /// How sweeps, background and obstacles are found.
    pub settings: Settings,
    /// Whether it only checks the description of the mount, and ends.
    pub check: bool,
    /// Lines of JSON.
    pub json: bool,
    /// When it ends by itself.
    pub bounds: Bounds,
    /// Where the domain may be, see [`Domain::candidates`].
    pub places: Vec<Domain>,
}

/// Follows the scans of a sensor and the angles of its mount, and writes to `out` what stands there, sweep by sweep; what is
/// wrong with the angles, and what is neither, to `notes` (stderr) if `out` is not JSON. Ends when the bounds are reached,
/// `stop` is set, or nobody reads any more.
///
/// # Errors
///
/// [`Kind::NoTopic`](scanhub_schema::Kind) with the sensors that there are, [`Kind::NoHub`](scanhub_schema::Kind) if bounded and there is none
/// at the start, [`Kind::Timeout`](scanhub_schema::Kind), [`Kind::Interrupted`](scanhub_schema::Kind) if bounded and `stop` came first; those of
/// publishing if it has a name. [`Kind::Check`](scanhub_schema::Kind) if a check has failed, and
/// [`Kind::Interrupted`](scanhub_schema::Kind) or [`Kind::Timeout`](scanhub_schema::Kind) if it ended too early.
pub fn tilt(
    options: &TiltOptions,
    out: &mut dyn Write,
    notes: &mut dyn Write,
    stop: &AtomicBool,
) -> Result<(), Failure> {
    let names = [(&options.sensor, Topic::Scan), (&options.angles, Topic::Tilt)]
        .map(|(sensor, topic)| TopicName { sensor: sensor.clone(), topic });
    let name = options.name.as_deref().unwrap_or(UNNAMED);
    let mut verb = Verb {
        options,
        tilting: Tilting::new(options.mount, options.settings),
        trouble: Trouble::default(),
        late_ns: 0,
        check: options.check.then(Check::default),
        teller: Teller {
            name,
            is_json: options.json,
            samples: Samples::new(name),
            told: Ok(()),
            out: Output::new(out),
            notes: Output::new(notes),
        },
        beams: None,
        missed: 0,
        summaries: names.len(),
    };
    let followed = follow(&names, &[], &options.places, &options.bounds, stop, &mut verb);
    let Verb { check: Some(check), teller, .. } = &mut verb else { return quiet(followed) };
    if check.sweeps() < check::SWEEPS {
        quiet(followed)?;
        let message = format!("the check ended after {} of {} whole sweeps", check.sweeps(), check::SWEEPS);
        let kind = if stop.load(Ordering::Relaxed) { Kind::Interrupted } else { Kind::Timeout };
        return Err(Failure::new(kind, message, "let it run until it ends by itself"));
    }
    quiet(check::tell(check, &options.mount, name, options.json, &mut teller.out))
}

/// What lines call one that publishes nothing.
const UNNAMED: &str = "tilted";
/// What is wrong with the angles for less than this time is counted, and not told.
const TOLD_AFTER_NS: u64 = 300_000_000;

struct Verb<'a> {
    options: &'a TiltOptions,
    tilting: Tilting,
    trouble: Trouble,
    /// The delay of the angles' stamps that was reported.
    late_ns: i64,
    check: Option<Check>,
    teller: Teller<'a>,
    /// Of the first scan.
    beams: Option<usize>,
    missed: u64,
    /// Topics that are not yet over.
    summaries: usize,
}

impl Sink for Verb<'_> {
    /// Publishes from the moment that it is known how long samples are.
    fn tick(&mut self, _: Instant) -> Result<(), End> {
        let samples = &mut self.teller.samples;
        match (&self.options.name, self.beams) {
            (Some(name), Some(beams)) if !samples.is_published() => {
                Ok(samples.publish(name, beams, &self.options.places)?)
            }
            _ => Ok(()),
        }
    }

    fn sample(&mut self, _: &TopicName, sample: &Sample) -> Result<(), End> {
        let Verb { tilting, teller, check, .. } = self;
        let mut take = |sweep: &Sweep<'_>| match check {
            Some(check) => check.take(sweep),
            None => teller.tell(sweep),
        };
        match sample {
            Sample::Scan(scan) => {
                let header = *scan.header();
                self.beams.get_or_insert(scan.beams());
                tilting.take_scan(header.stamp_first_ns, scan, &mut take);
                teller.samples.hear(&header);
                if let Some(trouble) = self.trouble.changed(header.stamp_first_ns, tilting.trouble()) {
                    teller.tell_trouble(trouble, tilting.late_ns())?;
                }
            }
            Sample::Tilt(said) => {
                let angle = Angle {
                    stamp_ns: said.header().stamp_first_ns,
                    angle_rad: said.angle_rad,
                    rate_rad_s: said.rate_rad_s,
                };
                tilting.take_angle(angle, &mut take);
            }
            _ => {}
        }
        if tilting.late_ns() != self.late_ns {
            self.late_ns = tilting.late_ns();
            teller.tell_late(&self.options.angles, self.trouble.told, self.late_ns)?;
        }
        if check.as_ref().is_some_and(|check| check.sweeps() >= check::SWEEPS) {
            // Ends without a summary.
            return Err(End::ReaderGone);
        }
        std::mem::replace(&mut teller.told, Ok(()))
    }

    fn notice(&mut self, names: &[Rc<TopicName>], notice: Notice) -> Result<(), End> {
        if let Notice::Missed(count) = notice {
            self.missed += count;
        }
        notice.tell(names, self.teller.is_json, &mut self.teller.out, &mut self.teller.notes)
    }

    fn summary(&mut self, _: &TopicName, _: &ReceiveStats) -> Result<(), End> {
        self.summaries -= 1;
        if self.summaries > 0 || self.check.is_some() {
            return Ok(());
        }
        let Teller { name, is_json, samples, out, .. } = &mut self.teller;
        let sum = lines::Sum {
            counts: self.tilting.counts(),
            late_ns: self.tilting.late_ns(),
            missed: self.missed,
            failed: samples.failed(),
        };
        match is_json {
            true => out.json(&lines::summary(name, &sum)),
            false => out.line(|line| lines::summary_text(line, &sum)),
        }
    }
}

/// What is wrong with the angles, once it has been so for a while.
#[derive(Default)]
struct Trouble {
    told: Option<Withheld>,
    now: Option<Withheld>,
    since_ns: u64,
}

impl Trouble {
    /// Takes what is so at the time of a scan; what is to be told, if it is news.
    fn changed(&mut self, stamp_ns: u64, now: Option<Withheld>) -> Option<Option<Withheld>> {
        if now != self.now || self.since_ns == 0 {
            (self.now, self.since_ns) = (now, stamp_ns);
        }
        let is_old = stamp_ns.saturating_sub(self.since_ns) >= TOLD_AFTER_NS;
        (is_old && now != self.told).then(|| {
            self.told = now;
            now
        })
    }
}

/// What writes the lines.
struct Teller<'a> {
    name: &'a str,
    is_json: bool,
    samples: Samples,
    /// Why it could not.
    told: Result<(), End>,
    out: Output<'a>,
    notes: Output<'a>,
}

impl Teller<'_> {
    fn tell(&mut self, sweep: &Sweep<'_>) {
        let (header, obstacles) = self.samples.take(sweep);
        let told = match self.is_json {
            true => self.out.json(&json::obstacles(self.name, header, obstacles)),
            false => self.out.line(|line| text::obstacles(line, header, obstacles)),
        };
        if self.told.is_ok() {
            self.told = told;
        }
    }

    fn tell_trouble(&mut self, trouble: Option<Withheld>, late_ns: i64) -> Result<(), End> {
        match self.is_json {
            true => self.out.json(&lines::angles(self.name, trouble, late_ns)),
            false => self.notes.line(|line| lines::angles_text(line, trouble)),
        }
    }

    fn tell_late(&mut self, mount: &str, trouble: Option<Withheld>, late_ns: i64) -> Result<(), End> {
        match self.is_json {
            true => self.out.json(&lines::angles(self.name, trouble, late_ns)),
            false => self.notes.line(|line| lines::late_text(line, mount, late_ns)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_wrong_for_a_moment_is_not_told() {
        const MS: u64 = 1_000_000;
        let mut trouble = Trouble::default();
        let (well, silent, jumped) = (None, Some(Withheld::Silent), Some(Withheld::Jumped));
        // At the start no angle has come yet.
        assert_eq!(trouble.changed(1000 * MS, silent), None);
        assert_eq!(trouble.changed(1027 * MS, well), None);
        assert_eq!(trouble.changed(1400 * MS, silent), None);
        assert_eq!(trouble.changed(1690 * MS, silent), None);
        assert_eq!(trouble.changed(1700 * MS, silent), Some(silent));
        assert_eq!(trouble.changed(1800 * MS, silent), None, "once");
        assert_eq!(trouble.changed(1900 * MS, jumped), None);
        assert_eq!(trouble.changed(2200 * MS, jumped), Some(jumped));
        assert_eq!([2300, 2600].map(|ms| trouble.changed(ms * MS, well)), [None, Some(well)]);
    }
}
