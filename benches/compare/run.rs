//! A run of one mechanism with one number of receivers and one length of messages. This module starts the processes,
//! controls them through all phases, and computes figures from their output.

use std::os::unix::net::UnixDatagram;

use super::message::{Mechanism, PHASES};
use super::process::control_path;
use crate::support::Outcome;
use crate::support::environment::{BenchEnvironment, Child, OutputLine, STEP_TIMEOUT};
use crate::support::figures::percentile;

/// A mechanism with a number of receivers and a length of messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Case {
    pub(crate) mechanism: Mechanism,
    /// Length of a message, in bytes.
    pub(crate) payload: usize,
    pub(crate) receivers: usize,
}

/// Figures of one phase.
#[derive(Clone, Debug)]
pub(crate) struct PhaseFigures {
    /// Time from just before the send until a receiver has the message, over all receivers: p50, p99 and p99.9, in
    /// microseconds.
    pub(crate) latency: [Option<f64>; 3],
    /// Time like `latency`, but only for the last receiver of each message. Only messages that all receivers have
    /// received count.
    pub(crate) last: [Option<f64>; 3],
    /// CPU time of the sender per message, in us. It includes writing the message and waiting until it is due.
    pub(crate) sender_us: f64,
    /// Part of `sender_us` that is spent on sending, in us. `None` if messages are not sent at a rate.
    pub(crate) sending_us: Option<f64>,
    /// CPU time of a receiver per message, in us; `None` if no message arrived.
    pub(crate) receiver_us: Option<f64>,
    /// Messages per second that a receiver received.
    pub(crate) rate_hz: f64,
    /// Messages that were not received, in %.
    pub(crate) missed_percent: f64,
    /// Number of messages that were sent, in percent of the number that the rate requires. `None` if messages are not
    /// sent at a rate.
    pub(crate) kept_percent: Option<f64>,
}

impl Case {
    /// Runs the case. Returns the index and the figures of each phase that the case has.
    pub(crate) fn measure(&self, environment: &BenchEnvironment) -> Outcome<Vec<(usize, PhaseFigures)>> {
        let place = environment.port("compare");
        let [payload, receivers] = [self.payload, self.receivers].map(|number| number.to_string());
        let words = [self.mechanism.name(), &payload, &receivers, environment.domain.name(), &place];
        let sender = environment.start_part(&[&["send"], &words[..]].concat())?;
        let ready = sender.wait_for_line("ready", STEP_TIMEOUT)?;
        let address = ready.words().get(1).ok_or("no address")?.to_string();
        let start = |number: usize| {
            environment.start_part(&[&["receive"], &words[..], &[&number.to_string(), &address]].concat())
        };
        let receivers = (0..self.receivers).map(start).collect::<Outcome<Vec<_>>>()?;
        for receiver in &receivers {
            receiver.wait_for_line("ready", STEP_TIMEOUT)?;
        }
        let tell = UnixDatagram::unbound()?;
        tell.connect(control_path(&place))?;
        tell.send(GO_MESSAGE)?;
        sender.wait_for_line("open", STEP_TIMEOUT)?;
        let mut measured = Vec::new();
        for (number, phase) in PHASES.iter().enumerate() {
            tell.send(GO_MESSAGE)?;
            let mut sent = Report::wait_for(&sender, "sent")?;
            let sending_ns = sent.numbers.remove(0);
            let reports =
                receivers.iter().map(|child| Report::wait_for(child, "took")).collect::<Outcome<Vec<_>>>()?;
            if number > 0 && phase.count(self.mechanism) > 0 {
                let mut figures = figures(&sent, &reports)?;
                if phase.period_ns > 0 {
                    let count = sent.numbers.len() as f64;
                    figures.sending_us = Some(sending_ns as f64 / 1e3 / count);
                    figures.kept_percent = Some(100.0 * count / phase.count(self.mechanism) as f64);
                }
                measured.push((number, figures));
            }
        }
        tell.send(GO_MESSAGE)?;
        for child in receivers.iter().chain([&sender]) {
            child.wait_for_line("end", STEP_TIMEOUT)?;
        }
        receivers.into_iter().chain([sender]).try_for_each(|child| child.guard.wait())?;
        Ok(measured)
    }
}

/// Output of a sending or receiving process about one phase.
struct Report {
    busy_ns: u64,
    /// For a sender, the CPU time of sending, followed by the time at which each message was sent. For a receiver, the
    /// number of each message and the time at which it was received, alternating.
    numbers: Vec<u64>,
}

impl Report {
    fn wait_for(child: &Child, word: &str) -> Outcome<Report> {
        let OutputLine { text, .. } = child.wait_for_line(word, STEP_TIMEOUT)?;
        let mut numbers = text.split_whitespace().skip(1).map(str::parse);
        let busy_ns = numbers.next().ok_or("no CPU time")??;
        Ok(Report { busy_ns, numbers: numbers.collect::<Result<_, _>>()? })
    }
}

fn figures(sent: &Report, receivers: &[Report]) -> Outcome<PhaseFigures> {
    let mut all = Vec::new();
    let mut last = vec![(0usize, 0u64); sent.numbers.len()];
    let mut end_ns = 0;
    for report in receivers {
        for message in report.numbers.chunks_exact(2) {
            let number = message[0] as usize;
            let sent_ns =
                *sent.numbers.get(number).ok_or_else(|| format!("message {number} was not sent"))?;
            let latency = message[1].saturating_sub(sent_ns);
            all.push(latency);
            last[number] = (last[number].0 + 1, last[number].1.max(latency));
            end_ns = end_ns.max(message[1]);
        }
    }
    let received = all.len();
    let of_all = last.iter().filter(|(count, _)| *count == receivers.len());
    let begin_ns = *sent.numbers.first().ok_or("nothing was sent")?;
    let expected = sent.numbers.len() * receivers.len();
    let busy_ns: u64 = receivers.iter().map(|report| report.busy_ns).sum();
    Ok(PhaseFigures {
        last: percentiles(of_all.map(|(_, latency)| *latency).collect()),
        latency: percentiles(all),
        sender_us: sent.busy_ns as f64 / 1e3 / sent.numbers.len() as f64,
        receiver_us: (received > 0).then(|| busy_ns as f64 / 1e3 / received as f64),
        rate_hz: received as f64
            / receivers.len() as f64
            / (end_ns.saturating_sub(begin_ns).max(1) as f64 / 1e9),
        missed_percent: 100.0 * (expected - received) as f64 / expected as f64,
        sending_us: None,
        kept_percent: None,
    })
}

/// Returns p50, p99 and p99.9 of `times` in us. `times` are in ns.
fn percentiles(times: Vec<u64>) -> [Option<f64>; 3] {
    let mut sorted: Vec<f64> = times.iter().map(|time| *time as f64 / 1e3).collect();
    sorted.sort_by(f64::total_cmp);
    [0.5, 0.99, 0.999].map(|part| percentile(&sorted, part))
}

const GO_MESSAGE: &[u8] = b"go";
