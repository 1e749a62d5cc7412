//! The ways in which consumers come to what two sensors see, each as processes on a stage: who belongs to the host,
//! and who only stands for hardware outside of it.

use std::thread;
use std::time::Duration;

use crate::account::{Snapshot, Span};
use crate::load::Load;
use crate::support::Outcome;
use crate::support::child::Child;
use crate::support::stage::{PATIENCE, SENSORS, Stage};
use crate::unit;

/// A way to the consumers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SetUp {
    /// Each has two serial lines of its own, reads them byte by byte and does everything itself.
    Bytes,
    /// The same, but each reads what is there.
    Blocks,
    /// Each gets bare telegrams by multicast and does the rest itself.
    Datagrams,
    /// Each takes the scans of the hub.
    Scans,
    /// Each takes the zones and the foreground of the hub.
    Results,
}

impl SetUp {
    /// In the order of the table.
    pub(crate) const ALL: [SetUp; 5] =
        [SetUp::Bytes, SetUp::Blocks, SetUp::Datagrams, SetUp::Scans, SetUp::Results];

    /// What a table calls it.
    pub(crate) fn name(self) -> &'static str {
        match self {
            SetUp::Bytes => "raw bytes",
            SetUp::Blocks => "raw bytes in blocks",
            SetUp::Datagrams => "datagrams",
            SetUp::Scans => "hub, scans",
            SetUp::Results => "hub, zones and foreground",
        }
    }

    /// Starts it for `count` consumers; with none there is nobody but who sends.
    pub(crate) fn start(self, count: usize) -> Outcome<Cast> {
        let stage = Stage::new()?;
        let part = |words: &[&str]| stage.part(&[&[WORD], words].concat());
        let domain = stage.domain.name();
        let (mut consumers, mut hub, mut outside) = (Vec::new(), None, Vec::new());
        match self {
            SetUp::Bytes | SetUp::Blocks => {
                let most = if self == SetUp::Bytes { "1" } else { "4096" };
                for number in 0..count {
                    let lines = SENSORS.map(|sensor| format!("{sensor}-{number}"));
                    outside.push(stage.simulate_streaming(&lines.each_ref().map(String::as_str))?);
                    let [front, rear] = lines.map(|line| stage.port(&line));
                    consumers.push(part(&["bytes", most, &front, &rear])?);
                }
            }
            SetUp::Datagrams => {
                let port = unit::port().to_string();
                for _ in 0..count {
                    consumers.push(part(&["datagrams", &port])?);
                }
                let sender = part(&["unit", &port])?;
                sender.await_line("ready", PATIENCE)?;
                outside.push(sender);
            }
            SetUp::Scans | SetUp::Results => {
                outside.push(stage.simulate_streaming(&SENSORS)?);
                hub.insert(stage.hub(&SENSORS)?).await_line("ready", PATIENCE)?;
                let topics = if self == SetUp::Scans { "scans" } else { "results" };
                for _ in 0..count {
                    consumers.push(part(&[topics, domain])?);
                }
            }
        }
        for consumer in &consumers {
            for sensor in SENSORS {
                consumer.await_line(&format!("had {sensor}"), PATIENCE)?;
            }
        }
        Ok(Cast { consumers, hub, outside, _stage: stage })
    }
}

/// Everybody who plays in a set-up; they go in this order.
pub(crate) struct Cast {
    pub(crate) consumers: Vec<Child>,
    pub(crate) hub: Option<Child>,
    /// Who stands for hardware.
    pub(crate) outside: Vec<Child>,
    _stage: Stage,
}

impl Cast {
    /// Watches it for `span`.
    pub(crate) fn watch(&self, span: Duration) -> Outcome<Load> {
        thread::sleep(SETTLING);
        let before = Snapshot::take()?;
        thread::sleep(span);
        let after = Snapshot::take()?;
        Load::of(&Span::new(&before, &after), self, self.hz(before.at_ns(), after.at_ns())?)
    }

    /// Scans a second that came in this time to whom the fewest came; 0 if there is nobody.
    fn hz(&self, from_ns: u64, to_ns: u64) -> Outcome<f64> {
        let mut least: Option<f64> = None;
        for consumer in &self.consumers {
            let lines = consumer.lines_so_far();
            for sensor in SENSORS {
                let mut said = Vec::new();
                for line in lines.iter().filter(|line| line.text.starts_with(&format!("had {sensor} "))) {
                    said.push((line.number(2)?, line.number(3)?));
                }
                said.retain(|(_, at_ns)| (from_ns..to_ns).contains(at_ns));
                let hz = match said[..] {
                    [(first, from_ns), .., (last, to_ns)] => {
                        (last - first) as f64 * 1e9 / (to_ns - from_ns) as f64
                    }
                    // Too slow, or the time too short, to tell.
                    _ => 0.0,
                };
                least = Some(least.map_or(hz, |least| least.min(hz)));
            }
        }
        Ok(least.unwrap_or_default())
    }
}

/// Second word of the command line of a part of this bench.
pub(crate) const WORD: &str = "host-load";
/// Until buffers, caches and rhythms are as they will be.
const SETTLING: Duration = Duration::from_secs(2);
