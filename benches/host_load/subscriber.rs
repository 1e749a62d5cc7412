//! Programs that use the data of both sensors. Each program is a process with a thread per sensor. A program uses raw
//! bytes, datagrams, the hub's scans, or the hub's results. The program regularly prints how many scans it has
//! received, which shows whether it can keep up with the sensors.

use std::hint::black_box;
use std::path::Path;
use std::thread;

use rustix::fs::{OFlags, fcntl_setfl};
use scanhub_drivers::lms;
use scanhub_drivers::lms::measured::MeasuredValues;
use scanhub_drivers::lms::telegram::Telegram;
use scanhub_drivers::lms::variant::{Mode, Unit};
use scanhub_preprocess::{background, marks, segments, zones};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Foreground, Marks, Pose, Scan, Zones};

use crate::datagrams;
use crate::line::DiscardingParser;
use crate::line::Parser;
use crate::support::baseline::SerialLine;
use crate::support::environment::SENSORS;
use crate::support::subscriber::subscribe;
use crate::support::{Outcome, clock};

/// Reads two serial lines, at most `max_read` bytes at once, like a very simple program. A thread per line blocks in
/// `read` and finds telegrams with a state machine of six states. The thread makes no other system call. With
/// `max_read` of 1, it acts like a program that reads single bytes. From a UART with a buffer of 16 bytes, more than 16
/// bytes are never available.
pub(crate) fn read_bytes(ports: [&str; 2], max_read: usize) -> Outcome<()> {
    run_for_both(|number, progress| {
        let line = SerialLine::open(Path::new(ports[number]), BAUD_RATE)?;
        fcntl_setfl(&line, OFlags::RDWR)?;
        let header = lms::measured::encode(0, Unit::Mm, &[0; BEAM_COUNT], 0x10).bytes()[..7].try_into()?;
        let (mut parser, mut processors, mut bytes) =
            (DiscardingParser::new(header), Processors::new(), vec![0; max_read]);
        loop {
            let len = line.read(&mut bytes)?;
            parser.read(&bytes[..len], &mut |accepted| {
                if Telegram::check(accepted.bytes).is_some_and(|telegram| processors.take(telegram)) {
                    progress.note();
                }
            });
        }
    })
}

/// Receives plain telegrams. Those of the first sensor arrive at `port`, and those of the second sensor at the next
/// port.
pub(crate) fn receive_datagrams(port: u16) -> Outcome<()> {
    run_for_both(|number, progress| {
        let (socket, mut processors) = (datagrams::receiver(port + number as u16)?, Processors::new());
        let mut datagram = [0; 2048];
        loop {
            let len = socket.recv(&mut datagram)?;
            if Telegram::check(&datagram[..len]).is_some_and(|telegram| processors.take(telegram)) {
                progress.note();
            }
        }
    })
}

/// Receives the hub's scans and reads every range.
pub(crate) fn receive_scans(domain: &str) -> Outcome<()> {
    run_for_both(|number, progress| {
        let mut scans = subscribe::<Scan>(domain, SENSORS[number])?;
        loop {
            let Some(scan) = scans.next()? else { continue };
            black_box(scan.ranges().iter().map(|&range| u32::from(range)).sum::<u32>());
            progress.note();
        }
    })
}

/// Receives the hub's zones and foreground, and reads both.
pub(crate) fn receive_results(domain: &str) -> Outcome<()> {
    run_for_both(|number, progress| {
        let mut foreground = subscribe::<Foreground>(domain, SENSORS[number])?;
        let mut zones = subscribe::<Zones>(domain, SENSORS[number])?;
        loop {
            let Some(foreground) = foreground.next()? else { continue };
            black_box((foreground.beams, foreground.segments().len()));
            // Take all zones up to those of the same scan, because earlier ones may report a silence.
            while let Some(zones) = zones.try_next()? {
                black_box((zones.verdict(), zones.nearest()));
                if zones.header().seq >= foreground.header().seq {
                    break;
                }
            }
            progress.note();
        }
    })
}

/// Runs `follow` for both sensors, each in its own thread. The process exits if `follow` fails for one of the sensors.
fn run_for_both(follow: impl Fn(usize, &mut Progress) -> Outcome<()> + Sync) -> Outcome<()> {
    let follow_or_end = |number: usize| {
        let mut progress = Progress { sensor: SENSORS[number], count: 0 };
        if let Err(error) = follow(number, &mut progress) {
            eprintln!("subscriber of {}: {error}", SENSORS[number]);
            std::process::exit(1);
        }
    };
    thread::scope(|scope| {
        scope.spawn(|| follow_or_end(1));
        follow_or_end(0);
    });
    Ok(())
}

/// Number of scans of a sensor that a subscriber has received.
struct Progress {
    sensor: &'static str,
    count: u64,
}

impl Progress {
    /// Counts a scan, and regularly prints the count: `had SENSOR COUNT NS`.
    fn note(&mut self) {
        self.count += 1;
        if self.count.is_multiple_of(REPORT_INTERVAL) {
            println!("had {} {} {}", self.sensor, self.count, clock::now());
        }
    }
}

/// Beams of a scan.
const BEAM_COUNT: usize = 361;
/// Baud rate of the simulated sensors.
const BAUD_RATE: u32 = 500_000;
/// Number of scans between two reports. 32 scans take a little less than a second.
const REPORT_INTERVAL: u64 = 32;

/// All processors for the scans of one sensor, with the same code and settings as in the hub: decoding, zones, marks,
/// background, and foreground with its segments.
struct Processors {
    zone_checker: zones::ZoneChecker,
    marks: marks::MarkDetector,
    model: background::BackgroundModel,
    segmenter: segments::Segmenter,
    scan: Box<Scan>,
    zones_out: Zones,
    found: Marks,
    foreground: Box<Foreground>,
}

impl Processors {
    fn new() -> Box<Processors> {
        let TopicLimits { beams, contents, .. } = TopicLimits::default();
        Box::new(Processors {
            zone_checker: zones::ZoneChecker::new(Pose::default(), &zones::Settings::default(), beams),
            marks: marks::MarkDetector::new(marks::Settings::default()),
            model: background::BackgroundModel::new(background::Settings::default(), beams),
            segmenter: segments::Segmenter::new(Pose::default(), beams),
            scan: Scan::zeroed(Scan::len(beams, contents)),
            zones_out: Zones::default(),
            found: Marks::default(),
            foreground: Foreground::of(beams),
        })
    }

    /// Processes `telegram`, and returns whether it was a scan.
    fn take(&mut self, telegram: Telegram<'_>) -> bool {
        let Some(measured) = MeasuredValues::decode(telegram) else { return false };
        measured.scan(MODE).write(&mut self.scan);
        self.zone_checker.update(&self.scan, &mut self.zones_out);
        self.marks.update(&self.scan, &mut self.found);
        self.model.update(&self.scan, &mut self.foreground);
        self.segmenter.update(&self.scan, &mut self.foreground);
        black_box((self.zones_out.verdict(), self.found.marks().len(), self.foreground.segments().len()));
        true
    }
}

/// Measuring mode of the sensors in this bench, which is the factory setting.
pub(crate) const MODE: Mode = Mode(1);
