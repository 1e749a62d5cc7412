//! Runs protocol state machines on an open port, for a user at a terminal: [`detect`] searches for a rotating scanner,
//! and [`drive`] runs a conversation with an LMS. A thread of the hub does the same for a link, without an end.

use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use port::{Port, clock};
use rustix::event::{PollFd, PollFlags, poll};
use scanhub_drivers::line::Session as _;
use scanhub_drivers::line::family::{Condition, Features, Model, Wanted};
use scanhub_drivers::line::{Account, Heard, Output};
use scanhub_drivers::lms::exchange::{self, Conversation};
use scanhub_drivers::scanner::{Introduction, Session, features};
use schema::{Failure, Family, Kind, MILLIS, Nanos};

/// A rotating scanner that was detected, and what was received from it.
#[derive(Clone, Debug)]
pub(crate) struct DetectedScanner {
    pub(crate) family: Family,
    /// Model that matches the received packets. Other models may match them, too.
    pub(crate) model: Option<Model>,
    /// Rate of the line, in bits per second.
    pub(crate) rate: u32,
    pub(crate) account: Account,
    /// The scanner's reply to a request for its identity and health; `None` if it streams without a request.
    pub(crate) said: Option<Introduction>,
    /// Number of packets with measured data.
    pub(crate) packets: u64,
    /// Points per second; 0 before the first complete revolution.
    pub(crate) points_per_second: f64,
    /// Revolutions per second; 0 before the first complete one.
    pub(crate) turns_per_second: f64,
    /// Problem of the scanner, as text.
    pub(crate) trouble: Option<String>,
}

impl DetectedScanner {
    /// Returns the number of points per revolution.
    pub(crate) fn points(&self) -> f64 {
        if self.turns_per_second > 0.0 { self.points_per_second / self.turns_per_second } else { 0.0 }
    }

    /// Returns the share of bytes that belong to no packet, 0 to 1. A fragment at the start of the stream does not
    /// count.
    pub(crate) fn damaged(&self) -> f64 {
        self.account.damaged as f64 / (self.account.in_telegrams + self.account.damaged).max(1) as f64
    }

    /// Returns whether the line damages most bytes, which makes every conclusion from the others unreliable.
    pub(crate) fn is_unreliable(&self) -> bool {
        self.damaged() > MOST_DAMAGED
    }

    /// Returns what the line does to the bytes and what to do about it, if it damages more than one in a hundred.
    pub(crate) fn line_trouble(&self) -> Option<String> {
        let damaged = self.damaged();
        (damaged > MAX_DAMAGED)
            .then(|| format!("{:.0} % of the bytes are damaged on the line: {LINE_REMEDY}", 100.0 * damaged))
    }
}

impl fmt::Display for DetectedScanner {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = self.model.map_or("a scanner".to_owned(), |model| model.name.to_uppercase());
        write!(f, "{name} at {} Bd", self.rate)
    }
}

/// Returns the families of rotating scanners. Families that stream without a request come first.
pub(crate) fn turning() -> Vec<(Family, &'static Features)> {
    let known = Family::ALL.into_iter().filter_map(|family| Some((family, features(family)?)));
    let mut known: Vec<_> = known.collect();
    known.sort_by_key(|(_, features)| !features.speaks_unasked);
    known
}

/// Searches `port` for a scanner of `family`, at all rates of the family unless the port has a fixed rate. Calls `look`
/// with each rate. Returns the scanner, if more packets arrived than could match by chance; otherwise the number of
/// bytes received.
///
/// Sends nothing to a scanner that streams without a request. From other scanners it requests identity and health, lets
/// them measure for a second, and stops them as a hub does.
///
/// # Errors
///
/// Returns [`Kind::PortMissing`] if the port disappears, and [`Kind::Interrupted`] if `stop` is set.
pub(crate) fn detect(
    port: &Port,
    (family, features): (Family, &Features),
    stop: &AtomicBool,
    mut look: impl FnMut(u32),
) -> Result<Result<DetectedScanner, u64>, Failure> {
    let fixed_rate = port.baud().is_none();
    let wanted = Wanted { fixed_rate, listen_only: features.speaks_unasked, ..Wanted::default() };
    let begun = clock::now();
    let Some(mut session) = Session::begin(family, wanted, begun) else { return Ok(Err(0)) };
    port.try_baud(session.rate()).map_err(|error| port_lost(port, &error))?;
    let mut heard = Received::default();
    let (first_rate, mut rate, mut rates) = (session.rate(), 0, 0);
    // A scanner may miss a request or respond late, and the line may damage the response.
    let mut rounds = if features.speaks_unasked { 1 } else { 3 };
    loop {
        if !fixed_rate && rate != session.rate() {
            (rate, rates) = (session.rate(), rates + 1);
            if rates > 1 && rate == first_rate && heard.said.is_none() {
                rounds -= 1;
            }
            if rounds == 0 {
                break;
            }
            look(rate);
        }
        let until = heard.drain(port, &mut session).map_err(|error| port_lost(port, &error))?;
        if stop.load(Ordering::Relaxed) {
            let _ = heard.end(port, &mut session);
            return Err(Failure::new(Kind::Interrupted, "interrupted", ""));
        }
        let now = clock::now();
        let is_detected = heard.packets >= MIN_PACKETS;
        let limit = match (&heard.said, heard.measures_since) {
            (Some(said), _) if said.condition == Condition::Error => now,
            (Some(_), Some(since)) => since + MEASURING_TIME,
            (Some(_), None) => heard.said_at + SPIN_UP_TIMEOUT,
            (None, Some(since)) if is_detected && heard.turns >= MIN_REVOLUTIONS => since + MEASURING_TIME,
            (None, _) if is_detected => begun + REVOLUTIONS_TIMEOUT,
            (None, _) if features.speaks_unasked => begun + PACKETS_TIMEOUT,
            (None, _) => begun + REPLY_TIMEOUT,
        };
        if now >= limit {
            break;
        }
        let until = until.min(limit);
        let mut fds = [PollFd::new(port, PollFlags::IN)];
        // An interrupted wait only ends early.
        let _ = poll(&mut fds, Some(&clock::span(now, until.min(now + STOP_CHECK_INTERVAL))));
        let len = port.read(session.spare()).map_err(|error| port_lost(port, &error))?;
        let now = clock::now();
        session.commit(now, len);
        if len == 0 && now >= until {
            session.handle_timeout(now);
        }
    }
    let mut trouble = session.trouble().map(|trouble| trouble.to_string());
    if heard.packets == 0 && heard.said.as_ref().is_some_and(|said| said.condition != Condition::Error) {
        trouble.get_or_insert_with(|| "it answers, but does not begin to measure".to_owned());
    }
    let (account, model) = (session.account(), session.model());
    heard.end(port, &mut session).map_err(|error| port_lost(port, &error))?;
    if heard.packets < MIN_PACKETS && heard.said.is_none() {
        return Ok(Err(account.read));
    }
    let Received { packets, period, points_per_second, said, .. } = heard;
    Ok(Ok(DetectedScanner {
        family,
        model,
        rate: session.rate(),
        account,
        said,
        packets,
        points_per_second: f64::from(points_per_second),
        turns_per_second: if period > 0 { 1e9 / period as f64 } else { 0.0 },
        trouble,
    }))
}

/// Returns the failure for a port called `name` at which no scanner of `family` was detected, after `bytes` bytes
/// arrived.
pub(crate) fn not_detected(name: &str, family: Family, features: &Features, bytes: u64) -> Failure {
    let mut rates: Vec<u32> = features.models.iter().map(|model| model.baud).collect();
    rates.sort_unstable();
    rates.dedup();
    let rates: Vec<String> = rates.iter().map(u32::to_string).collect();
    let (came, remedy) = match bytes {
        0 => {
            ("no byte arrived".to_owned(), "check power and cable, each transmitter to the other's receiver")
        }
        bytes => (
            format!("{bytes} bytes arrived that are none"),
            "another device, or another rate? A serial server must be set to the scanner's rate",
        ),
    };
    let sought = if features.speaks_unasked { "packets" } else { "answer" };
    let what =
        format!("{name}: no {sought} of family {} at {} Bd; {came}", family.name(), rates.join(" or "));
    Failure::new(Kind::Timeout, what, remedy)
}

/// Statistics of the outputs of a session.
#[derive(Default)]
struct Received {
    packets: u64,
    /// Time of the first packet.
    measures_since: Option<Nanos>,
    turns: u32,
    /// Period of the last revolution.
    period: Nanos,
    points_per_second: f32,
    said: Option<Introduction>,
    said_at: Nanos,
    /// State of the line DTR that the session requested last.
    dtr: Option<bool>,
}

impl Received {
    /// Carries out the actions of `session` until it waits. Returns the end of the wait.
    fn drain(&mut self, port: &Port, session: &mut Session) -> std::io::Result<Nanos> {
        loop {
            match session.poll_output() {
                Output::SetRate(rate) => {
                    port.try_baud(rate)?;
                }
                // Before the scanner has replied, its motor stays as it is.
                Output::SetDtr(on) => {
                    self.dtr = Some(on);
                    if self.said.is_some() {
                        port.set_dtr(on)?;
                    }
                }
                Output::Transmit { byte, .. } => {
                    if self.said.is_none() {
                        self.said = session.introduction();
                        self.said_at = clock::now();
                        match &self.said {
                            // The session would reset it next.
                            Some(said) if said.condition == Condition::Error => return Ok(self.said_at),
                            Some(_) => self.dtr.map_or(Ok(()), |on| port.set_dtr(on))?,
                            None => {}
                        }
                    }
                    port.write(byte)?;
                    session.transmitted(clock::now());
                }
                Output::Heard(Heard::Packets(received)) => {
                    if !received.message.is_reply {
                        self.measures_since.get_or_insert_with(clock::now);
                        self.packets += received.message.count as u64;
                    }
                }
                Output::Heard(Heard::Turn(turn)) => {
                    self.turns += 1;
                    self.period = turn.period;
                    self.points_per_second = turn.points_per_second;
                }
                Output::Rest(until) => {
                    std::thread::sleep(Duration::from_nanos(until.saturating_sub(clock::now())));
                    return Ok(until);
                }
                Output::Wait { until, .. } => return Ok(until),
            }
        }
    }

    /// Stops a scanner that measures on request, and its motor, as a hub does when it exits.
    fn end(&self, port: &Port, session: &mut Session) -> std::io::Result<()> {
        let measures = self.said.as_ref().is_some_and(|said| said.condition != Condition::Error);
        if !measures || !session.end(clock::now()) {
            return Ok(());
        }
        loop {
            match session.poll_output() {
                Output::SetDtr(on) => port.set_dtr(on)?,
                Output::Transmit { byte, .. } => {
                    port.write(byte)?;
                    session.transmitted(clock::now());
                }
                Output::SetRate(_) | Output::Heard(_) => {}
                Output::Rest(_) | Output::Wait { .. } => return Ok(()),
            }
        }
    }
}

/// Remedy for a line that damages bytes.
pub(crate) const LINE_REMEDY: &str =
    "a shorter or shielded cable, ground beside the signal, 3.3 V levels; another adapter";
/// Maximum share of damaged bytes on a good line.
const MAX_DAMAGED: f64 = 0.01;
/// Share of damaged bytes that makes conclusions from the others unreliable.
pub(crate) const MOST_DAMAGED: f64 = 0.5;

/// Minimum number of packets of a scanner. Other bytes pass a checksum of 8 bits now and then, but not that often.
const MIN_PACKETS: u64 = 20;
/// Minimum number of complete revolutions for a measurement of the head's speed.
const MIN_REVOLUTIONS: u32 = 5;
/// Timeout for a reply at all rates of a family, or at one rate over a network.
const REPLY_TIMEOUT: Nanos = 2_000 * MILLIS;
/// Minimum time for which measured data are received.
const MEASURING_TIME: Nanos = 1_000 * MILLIS;
/// Timeout for the first packet of a scanner whose motor has to spin up. It allows for many damaged replies.
const SPIN_UP_TIMEOUT: Nanos = 7_000 * MILLIS;
/// Timeout for the first packets of a scanner that streams without a request, at two rates.
const PACKETS_TIMEOUT: Nanos = 650 * MILLIS;
/// Timeout for [`MIN_REVOLUTIONS`]. It is long enough for a head that makes two revolutions per second.
const REVOLUTIONS_TIMEOUT: Nanos = 4_000 * MILLIS;

/// Runs `conversation` with an LMS on `port` until it ends. Calls `progress` before each wait. Skips rates that the
/// port cannot have.
///
/// # Errors
///
/// Returns [`Kind::PortMissing`] if the port disappears, and [`Kind::Interrupted`] if `stop` is set.
pub(crate) fn drive<C: Conversation>(
    port: &Port,
    conversation: &mut C,
    stop: &AtomicBool,
    mut progress: impl FnMut(&C),
) -> Result<(), Failure> {
    let mut refused = Vec::new();
    while let Some(until) =
        carry_out(port, conversation, &mut refused).map_err(|error| port_lost(port, &error))?
    {
        progress(conversation);
        if stop.load(Ordering::Relaxed) {
            return Err(Failure::new(Kind::Interrupted, "interrupted", ""));
        }
        let now = clock::now();
        let mut fds = [PollFd::new(port, PollFlags::IN)];
        // An interrupted wait only ends early.
        let _ = poll(&mut fds, Some(&clock::span(now, until.min(now + STOP_CHECK_INTERVAL))));
        let len = port.read(conversation.spare()).map_err(|error| port_lost(port, &error))?;
        let now = clock::now();
        conversation.commit(now, len);
        if len == 0 && now >= until {
            conversation.handle_timeout(now);
        }
    }
    Ok(())
}

/// Carries out the actions of `conversation` until it waits or ends. Returns the end of the wait. Logs a rate that the
/// port refuses, unless it is in `refused`, and adds it there.
fn carry_out<C: Conversation>(
    port: &Port,
    conversation: &mut C,
    refused: &mut Vec<u32>,
) -> std::io::Result<Option<Nanos>> {
    loop {
        match conversation.poll_output() {
            exchange::Output::SetBaud(baud) => {
                if let Some(error) = port.try_baud(baud.rate())?
                    && !refused.contains(&baud.rate())
                {
                    refused.push(baud.rate());
                    match port {
                        Port::Tty(tty) => tracing::warn!("{}: {error}", tty.device().display()),
                        Port::Tcp(_) => tracing::warn!("{error}"),
                    }
                }
            }
            exchange::Output::Transmit { byte, not_before } => {
                let now = clock::now();
                if not_before > now {
                    std::thread::sleep(Duration::from_nanos(not_before - now));
                }
                if conversation.restart_if_late(clock::now()) {
                    continue;
                }
                port.write(byte)?;
                conversation.transmitted(clock::now());
            }
            exchange::Output::Wait { until } => return Ok(Some(until)),
            exchange::Output::Done => return Ok(None),
        }
    }
}

/// Returns the failure for a `port` that can no longer be used. A serial server that already has a client closes the
/// connection of another one.
fn port_lost(port: &Port, error: &std::io::Error) -> Failure {
    if let Port::Tcp(_) = port {
        return Failure::new(
            Kind::PortBusy,
            format!("the connection is over: {error}"),
            "a serial server has one client at a time: end the other program that is connected to it, such as a hub, and try \
             again; if there is none, was the server switched off?",
        );
    }
    Failure::new(
        Kind::PortMissing,
        format!("the port went away: {error}"),
        "was it unplugged? plug it in and try again",
    )
}

/// Interval between checks for an interrupt, and between reports of progress.
const STOP_CHECK_INTERVAL: Nanos = 100 * MILLIS;
