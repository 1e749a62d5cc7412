//! Finds the family of a rotating scanner, and the share of bytes that its line damages, for a person at a terminal.
//!
//! The module sends nothing to a scanner that streams by itself. From other scanners it requests identity and health, lets
//! them measure for a second, and stops them as a hub does.

use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use port::{Port, clock};
use rustix::event::{PollFd, PollFlags, poll};
use scanhub_drivers::line::family::{Condition, Features, Model, Wanted};
use scanhub_drivers::line::{Account, Heard, Output, Session as _};
use scanhub_drivers::scanner::{Introduction, Session, features};
use schema::{Failure, Family, Kind, MILLIS, Nanos};

use crate::drive::gone;

/// What was heard of a scanner whose head turns.
#[derive(Clone, Debug)]
pub(crate) struct Overheard {
    pub(crate) family: Family,
    /// What speaks like it: of models that cannot be told apart, one.
    pub(crate) model: Option<Model>,
    /// In bits per second.
    pub(crate) rate: u32,
    pub(crate) account: Account,
    /// What it said of itself, if it was asked.
    pub(crate) said: Option<Introduction>,
    /// Packets of measured data.
    pub(crate) packets: u64,
    /// Points that it measures in a second; 0 as long as no turn was whole.
    pub(crate) points_per_second: f64,
    /// Turns of the head in a second; 0 as long as none was whole.
    pub(crate) turns_per_second: f64,
    /// Why it is not where it should be, in words.
    pub(crate) trouble: Option<String>,
}

impl Overheard {
    /// Points in a turn.
    pub(crate) fn points(&self) -> f64 {
        if self.turns_per_second > 0.0 { self.points_per_second / self.turns_per_second } else { 0.0 }
    }

    /// Share of the bytes that were in nothing, 0 to 1, without a piece of what was in flight at first.
    pub(crate) fn damaged(&self) -> f64 {
        self.account.damaged as f64 / (self.account.in_telegrams + self.account.damaged).max(1) as f64
    }
}

impl Overheard {
    /// Returns whether the line damages most bytes, which makes every conclusion from the others unreliable.
    pub(crate) fn is_unreliable(&self) -> bool {
        self.damaged() > MOST_DAMAGED
    }

    /// Returns what the line does to the bytes and what to do about it, if it damages more than one in a hundred.
    pub(crate) fn line_trouble(&self) -> Option<String> {
        let damaged = self.damaged();
        (damaged > WELL)
            .then(|| format!("{:.0} % of the bytes are damaged on the line: {LINE_REMEDY}", 100.0 * damaged))
    }
}

impl fmt::Display for Overheard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = self.model.map_or("a scanner".to_owned(), |model| model.name.to_uppercase());
        write!(f, "{name} at {} Bd", self.rate)
    }
}

/// The families whose heads turn: first those that speak unasked.
pub(crate) fn turning() -> Vec<(Family, &'static Features)> {
    let known = Family::ALL.into_iter().filter_map(|family| Some((family, features(family)?)));
    let mut known: Vec<_> = known.collect();
    known.sort_by_key(|(_, features)| !features.speaks_unasked);
    known
}

/// Looks at `port` for a scanner of `family`, at all its rates unless the port has its own rate; `look` sees each of
/// them. Returns what was received, if it was too much for a chance match; otherwise the number of bytes.
///
/// [`Kind::PortMissing`] if the port goes away, [`Kind::Interrupted`] if `stop` is set.
pub(crate) fn listen(
    port: &Port,
    (family, features): (Family, &Features),
    stop: &AtomicBool,
    mut look: impl FnMut(u32),
) -> Result<Result<Overheard, u64>, Failure> {
    let fixed_rate = port.baud().is_none();
    let wanted = Wanted { fixed_rate, listen_only: features.speaks_unasked, ..Wanted::default() };
    let begun = clock::now();
    let Some(mut session) = Session::begin(family, wanted, begun) else { return Ok(Err(0)) };
    port.try_baud(session.rate()).map_err(|error| gone(port, &error))?;
    let mut heard = Turns::default();
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
        let until = heard.drain(port, &mut session).map_err(|error| gone(port, &error))?;
        if stop.load(Ordering::Relaxed) {
            let _ = heard.end(port, &mut session);
            return Err(Failure::new(Kind::Interrupted, "interrupted", ""));
        }
        let now = clock::now();
        let is_heard = heard.packets >= ENOUGH;
        let limit = match (&heard.said, heard.measures_since) {
            (Some(said), _) if said.condition == Condition::Error => now,
            (Some(_), Some(since)) => since + SECOND,
            (Some(_), None) => heard.said_at + BEGINS,
            (None, Some(since)) if is_heard && heard.turns >= TURNS => since + SECOND,
            (None, _) if is_heard => begun + LONGEST,
            (None, _) if features.speaks_unasked => begun + SILENT,
            (None, _) => begun + UNANSWERED,
        };
        if now >= limit {
            break;
        }
        let until = until.min(limit);
        let mut fds = [PollFd::new(port, PollFlags::IN)];
        // An interrupted wait is a short one.
        let _ = poll(&mut fds, Some(&clock::span(now, until.min(now + LOOK))));
        let len = port.read(session.spare()).map_err(|error| gone(port, &error))?;
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
    heard.end(port, &mut session).map_err(|error| gone(port, &error))?;
    if heard.packets < ENOUGH && heard.said.is_none() {
        return Ok(Err(account.read));
    }
    let Turns { packets, period, points_per_second, said, .. } = heard;
    Ok(Ok(Overheard {
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

/// Why a scanner of `family` at a port called `name` was not heard, although `bytes` came.
pub(crate) fn not_heard(name: &str, family: Family, features: &Features, bytes: u64) -> Failure {
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

/// What a session handed out.
#[derive(Default)]
struct Turns {
    packets: u64,
    /// Time of the first packet.
    measures_since: Option<Nanos>,
    turns: u32,
    /// Of the last turn.
    period: Nanos,
    points_per_second: f32,
    said: Option<Introduction>,
    said_at: Nanos,
    /// State of the line DTR that the session requested last.
    dtr: Option<bool>,
}

impl Turns {
    /// Does what `session` wants until it wants to wait; until when.
    fn drain(&mut self, port: &Port, session: &mut Session) -> std::io::Result<Nanos> {
        loop {
            match session.poll_output() {
                Output::SetRate(rate) => {
                    port.try_baud(rate)?;
                }
                // Its motor stays as it is until the scanner measures.
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

    /// Stops a scanner that measures on request, and its motor, as a hub does at its end.
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
/// Share of damaged bytes up to which a line is well.
const WELL: f64 = 0.01;
/// Share of damaged bytes that makes conclusions from the others unreliable.
pub(crate) const MOST_DAMAGED: f64 = 0.5;

/// Other bytes pass a checksum of 8 bits now and then: not so often.
const ENOUGH: u64 = 20;
/// Whole turns that tell how it is.
const TURNS: u32 = 5;
/// No answer at any rate takes less than that, behind a network none at one.
const UNANSWERED: Nanos = 2_000 * MILLIS;
/// Minimum time for which measured data are received.
const SECOND: Nanos = 1_000 * MILLIS;
/// A scanner whose motor has to get up to speed measures by then, even if many answers are damaged before.
const BEGINS: Nanos = 7_000 * MILLIS;
/// No packet at two rates takes less than that.
const SILENT: Nanos = 650 * MILLIS;
/// A head that turns twice a second has turned often enough.
const LONGEST: Nanos = 4_000 * MILLIS;
/// Between two looks whether somebody wants to stop.
const LOOK: Nanos = 100 * MILLIS;
