//! The conversation with the sensor: what came and what did not, and what follows from it. How a sensor is found is
//! in [`crate::lms::search`], how it is brought to a stream in [`crate::lms::start`], and to rest in [`crate::lms::pause`]. Knows telegrams and deadlines, no bytes
//! and no port. It never says anything that outlives a power cycle.

use crate::line::State;
use crate::lms::command::{MODE, Request};
use crate::lms::fast_switch::FastSwitches;
use crate::lms::header::{Expect, StreamHeader, is_data};
use crate::lms::identity::Identity;
use crate::lms::measured::Measured;
use crate::lms::outgoing::{FORGOTTEN, NAK_PAUSE, Outgoing};
use crate::lms::phase::{
    BESIDE_VALUES, OVERLOOKED, PAUSE, Phase, Progress, QUESTION_PAUSE, QUESTION_ROUNDS, QUESTIONS, SILENCE,
    Settings, Step,
};
use crate::lms::reply::{POWER_ON, Reply};
use crate::lms::search::POWER_ON_BAUD;
use crate::lms::sensor::{Sensor, Trouble};
use crate::lms::telegram::{REPLY, Telegram};
use crate::lms::variant::Baud;
use schema::Nanos;

#[derive(Clone, Debug)]
pub(crate) struct Dialogue {
    pub(crate) settings: Settings,
    pub(crate) phase: Phase,
    pub(crate) open: Option<Outgoing>,
    pub(crate) change_baud: Option<Baud>,
    pub(crate) baud: Baud,
    pub(crate) sensor: Sensor,
    /// What an earlier session knew of it; used until the first request is sent.
    pub(crate) recalled: Option<Identity>,
    /// The most likely rate of a sensor that does not stream when a session begins.
    pub(crate) rest_at: Baud,
    /// The rate that is asked first.
    pub(crate) first: Baud,
    /// The rate at which the search had its last answer.
    pub(crate) found_at: Option<Baud>,
    /// Rate to stream at, unless the line cannot carry it.
    wanted: Baud,
    /// What is in the way now; [`Dialogue::trouble`] is what is shown.
    pub(crate) trouble: Option<Trouble>,
    pub(crate) fast_switches: FastSwitches,
    /// A user paused the sensor.
    pub(crate) is_paused: bool,
    /// The sensor keeps another variant than the wanted one.
    pub(crate) variant_refused: bool,
    pub(crate) resyncs: u64,
    /// Restarts of the sensor.
    pub(crate) restarts: u64,
    /// Whether a telegram has arrived since the session began or the last banner. Without it, a banner is first contact, or
    /// a copy of the last one.
    is_in_contact: bool,
    /// Rate of the last stream, until a request stops it or the sensor is found again.
    pub(crate) streamed_at: Option<Baud>,
    /// Bytes came since it began to listen, or to search for another round.
    pub(crate) heard: bool,
    /// When the last telegram came.
    pub(crate) quiet_since: Nanos,
}

impl Dialogue {
    pub(crate) fn new(settings: Settings, now: Nanos) -> Self {
        let mut dialogue = Dialogue {
            settings,
            phase: Phase::Following,
            open: None,
            change_baud: None,
            baud: settings.baud,
            sensor: Sensor::default(),
            recalled: None,
            rest_at: POWER_ON_BAUD,
            first: POWER_ON_BAUD,
            found_at: None,
            wanted: settings.baud,
            trouble: None,
            fast_switches: FastSwitches::default(),
            is_paused: false,
            variant_refused: false,
            resyncs: 0,
            restarts: 0,
            is_in_contact: false,
            streamed_at: None,
            heard: false,
            quiet_since: now,
        };
        if !settings.listen_only {
            dialogue.begin(now);
        }
        dialogue
    }

    pub(crate) fn state(&self) -> State {
        match self.phase {
            _ if self.is_paused => State::Paused,
            Phase::Listening { shown, .. } => shown,
            Phase::Probing { .. } => State::Probing,
            Phase::Starting { .. } if self.baud != self.settings.baud => State::Switching,
            Phase::Starting { .. } => State::Starting,
            Phase::Streaming { .. } | Phase::Following => State::Streaming,
            Phase::Paused { .. } => State::Paused,
        }
    }

    /// What is in the way, and else what stays so. It is in nobody's way during a pause.
    pub(crate) fn trouble(&self) -> Option<Trouble> {
        if self.is_paused {
            return self.trouble;
        }
        let has_other_angles = self.sensor.has_other_angles().then_some(Trouble::AnglesUnknown);
        let no_ranges = self.sensor.mode.filter(|mode| !mode.has_ranges()).map(Trouble::NoRanges);
        let variant_refused = self.variant_refused.then_some(Trouble::VariantRefused);
        let instead = self.rate_in_place_of_fast();
        let is_concerned = self.wanted == FAST && self.fast_switches.have_failed();
        let needs_rs422 = is_concerned.then_some(Trouble::NeedsRs422 { instead });
        // While the scanner is lost, it explains every other finding.
        let is_lost = self.fast_switches.have_lost();
        let first = needs_rs422.filter(|_| is_lost).or(self.trouble);
        first.or(has_other_angles).or(no_ranges).or(needs_rs422).or(variant_refused)
    }

    /// The rate to set on the port now.
    pub(crate) fn take_change_baud(&mut self) -> Option<Baud> {
        self.change_baud.take()
    }

    pub(crate) fn outgoing(&mut self) -> Option<&mut Outgoing> {
        self.open.as_mut()
    }

    pub(crate) fn awaits_acknowledge(&self) -> bool {
        self.open.is_some()
    }

    /// Bytes came, whatever they are.
    pub(crate) fn hear(&mut self) {
        self.heard = true;
        let baud = self.baud;
        self.open.iter_mut().for_each(|open| open.hear(baud));
    }

    /// Which headers may come.
    pub(crate) fn expect(&self) -> Expect {
        match self.phase {
            Phase::Streaming { header, .. } => {
                Expect::Stream { header, reply: self.open.as_ref().map(Outgoing::reply) }
            }
            _ => Expect::Anything,
        }
    }

    /// Returns when the dialogue has to act without a byte: the end of its phase or of the wait for a reply, or the time at
    /// which the next byte of a request may leave.
    pub(crate) fn deadline(&self) -> Nanos {
        let phase_ends_at = match self.phase {
            Phase::Listening { give_up_at, quiet_at, .. } => {
                if self.heard {
                    give_up_at
                } else {
                    quiet_at
                }
            }
            Phase::Streaming { silent_at, .. } => silent_at,
            _ => Nanos::MAX,
        };
        let Some(request) = &self.open else { return phase_ends_at };
        let next_byte_at = request.next_at().unwrap_or(Nanos::MAX);
        phase_ends_at.min(request.give_up_at()).min(next_byte_at)
    }

    pub(crate) fn handle_timeout(&mut self, now: Nanos) {
        match self.phase {
            Phase::Listening { give_up_at, quiet_at, attempt, .. }
                if now >= give_up_at || (now >= quiet_at && !self.heard) =>
            {
                return self.probe(now, attempt);
            }
            Phase::Streaming { silent_at, .. } if now >= silent_at => {
                self.resyncs += 1;
                self.trouble = Some(Trouble::Silence);
                self.sensor.forget();
                // Its cable may be back sooner than its power.
                self.first = self.settings.baud;
                return self.listen(now, State::Silent);
            }
            _ => {}
        }
        if self.open.as_ref().is_some_and(|open| now >= open.give_up_at()) {
            self.retry(now);
        }
    }

    pub(crate) fn on_acknowledge(&mut self, now: Nanos) {
        let baud = self.baud;
        if let Some(open) = self.open.as_mut().filter(|open| open.is_out()) {
            open.acknowledged(now, baud);
        }
    }

    /// While the rate is sought or a stream is broken off, a NAK proves nothing: the rest of a scan, or a stream at
    /// another rate, has such bytes, and who believes them asks in vain. Then only time says no.
    pub(crate) fn on_nak(&mut self, now: Nanos) {
        let credible = !matches!(self.phase, Phase::Probing { .. }) && !self.sensor.streams;
        if credible && self.open.as_ref().is_some_and(Outgoing::is_out) {
            self.retry(now + NAK_PAUSE);
        }
    }

    /// A telegram came whose first byte arrived at `first`. One that cannot be read, which has no `reply`, is an answer all
    /// the same.
    pub(crate) fn on_telegram(
        &mut self,
        telegram: Telegram<'_>,
        reply: Option<Reply<'_>>,
        first: Nanos,
        now: Nanos,
    ) {
        self.quiet_since = now;
        // A lost scanner needs a power cycle, so that restart does not count as a sign of a weak supply.
        let is_expected_restart = self.fast_switches.have_lost();
        // A telegram that was read before a change of the rate arrived at the previous rate.
        let is_fast = self.baud == FAST && self.change_baud.is_none();
        if self.fast_switches.receive(is_fast) {
            self.settings.baud = self.wanted;
            // Report a rate even without a search, so that the reset count is saved with it.
            self.found_at = self.found_at.or(Some(self.rest_at));
        }
        self.sensor.learn(reply.as_ref(), telegram);
        if telegram.command() == POWER_ON {
            let is_restart = core::mem::take(&mut self.is_in_contact) && !is_expected_restart;
            self.restarts += u64::from(is_restart);
            self.streamed_at = None;
            return self.on_power_on(now);
        }
        self.is_in_contact = true;
        if is_data(telegram.command()) {
            let measured = match reply {
                Some(Reply::Measured(measured)) if measured.partial().is_none() => Some(measured),
                _ => None,
            };
            return self.on_data(telegram, measured, first, now);
        }
        let expected = telegram.command() == crate::lms::reply::REFUSED
            || self.open.as_ref().is_some_and(|open| open.reply() == telegram.command());
        if let Some(open) = self.open.take_if(|open| expected && open.is_out()) {
            self.on_reply(open.request, reply, now);
        }
    }

    /// The sensor sends unasked; `measured` is a whole scan.
    fn on_data(&mut self, telegram: Telegram<'_>, measured: Option<Measured<'_>>, first: Nanos, now: Nanos) {
        let at_rate = self.baud == self.settings.baud;
        let next_silence = self.silent_at(now);
        match self.phase {
            // It came at the rate that is left now.
            _ if self.change_baud.is_some() => return,
            Phase::Streaming { header, silent_at: ref mut at, .. } => {
                // One of another kind was judged before this stream was known.
                if telegram.bytes().starts_with(&header) {
                    *at = next_silence;
                    self.question(now);
                }
            }
            Phase::Following => return,
            Phase::Paused { .. } => {
                if self.open.is_none() {
                    self.stop_again(now);
                }
            }
            Phase::Listening { .. } | Phase::Probing { .. } if self.is_paused => self.stop(now),
            Phase::Listening { shown: State::Starting, .. } if measured.is_some() => {
                self.stream(telegram, measured, now);
            }
            Phase::Listening { .. } | Phase::Probing { .. } => {
                if at_rate && measured.is_some_and(|measured| self.is_wanted(measured)) {
                    self.stream(telegram, measured, now);
                } else {
                    self.sensor.streams = true;
                    self.note_found(false);
                    self.proceed(Progress::BEGIN, now);
                }
            }
            Phase::Starting { step: Step::Stream, .. } if measured.is_some() => {
                if self.open.as_ref().is_none_or(Outgoing::is_out) {
                    self.stream(telegram, measured, now);
                }
            }
            Phase::Starting { .. } => {}
        }
        if self.open.as_ref().is_some_and(|open| open.out_at().is_some_and(|out| first > out + OVERLOOKED)) {
            self.retry(now);
        }
    }

    /// The sensor was without power, or was reset: whatever it was set to is gone, and it is there at this rate.
    fn on_power_on(&mut self, now: Nanos) {
        match self.phase {
            Phase::Following => {}
            _ if self.is_paused => self.come_to_rest(),
            phase => {
                self.resyncs += u64::from(matches!(phase, Phase::Streaming { .. }));
                self.enter(Step::Check, Progress::BEGIN, now);
            }
        }
    }

    fn on_reply(&mut self, request: Request, reply: Option<Reply<'_>>, now: Nanos) {
        // A sensor that does not report its state may be streaming: it is stopped, a limited number of times.
        self.sensor.streams |= request == Request::Status && !matches!(reply, Some(Reply::Status(_)));
        match self.phase {
            Phase::Probing { .. } if self.is_paused => self.stop(now),
            Phase::Probing { .. } => {
                self.found_at = Some(self.baud);
                self.note_found(matches!(reply, Some(Reply::Status(_))) && !self.sensor.streams);
                // Somebody is there after all.
                self.trouble
                    .take_if(|trouble| matches!(trouble, Trouble::NoAnswer { .. } | Trouble::Silence));
                if request == Request::Type {
                    // The line was silent until it was asked. What else it does is asked at the wanted rate.
                    self.sensor.streams = false;
                }
                self.proceed(Progress::begin(request, reply.as_ref()), now);
            }
            Phase::Starting { step, progress } => self.on_step(step, progress, request, reply, now),
            Phase::Paused { .. } => self.on_stopped(reply, now),
            Phase::Streaming { .. } | Phase::Listening { .. } | Phase::Following => {}
        }
    }

    /// Counts a restart whose banner was lost: the sensor streamed and no request stopped it, but now it `is_idle` or has
    /// another rate.
    fn note_found(&mut self, is_idle: bool) {
        let has_restarted = self.streamed_at.take().is_some_and(|baud| baud != self.baud || is_idle);
        self.restarts += u64::from(has_restarted);
    }

    /// No reply to the open request: again, or on without it.
    fn retry(&mut self, at: Nanos) {
        let Some(open) = &mut self.open else { return };
        let request = open.request;
        // What it did then is asked, not repeated.
        let heard = open.reply() == MODE_REPLY && open.is_acknowledged();
        if !heard && open.again(at) {
            return;
        }
        self.open = None;
        match self.phase {
            Phase::Probing { attempt } => self.search_on(attempt, at),
            Phase::Starting { step, progress } => self.on_no_reply(step, progress, request, heard, at),
            Phase::Paused { .. } => self.stop_again(at),
            Phase::Streaming { .. } | Phase::Listening { .. } | Phase::Following => {}
        }
    }

    /// The sensor said no: everything begins again, but not at once.
    pub(crate) fn refused(&mut self, request: Request, now: Nanos) {
        self.trouble = Some(Trouble::Refused(request));
        self.probe(now + PAUSE, 0);
    }

    /// Whether a running stream has the beams asked for; a sensor that refused them is taken as it is.
    fn is_wanted(&self, measured: Measured<'_>) -> bool {
        measured.count() == self.settings.variant.beams() || self.variant_refused
    }

    /// Time between two telegrams of the variant asked for.
    pub(crate) fn period(&self) -> Nanos {
        let Settings { variant, baud, .. } = self.settings;
        variant.period(2 * variant.beams() + BESIDE_VALUES, baud.rate())
    }

    /// Until when measured data may stay out: the paper's second, and on a slow line two telegrams' worth.
    pub(crate) fn silent_at(&self, now: Nanos) -> Nanos {
        now + SILENCE.max(5 * self.period() / 2)
    }

    /// Measured data come, and are taken as they are.
    fn stream(&mut self, telegram: Telegram<'_>, measured: Option<Measured<'_>>, now: Nanos) {
        let Some(&header) = telegram.bytes().first_chunk::<{ size_of::<StreamHeader>() }>() else { return };
        let as_asked = measured.is_some_and(|scan| scan.count() == self.settings.variant.beams());
        if let Some(known) = self.recalled.take_if(|known| known.header == header) {
            self.sensor.recall(known);
        }
        self.trouble = None;
        self.variant_refused = !as_asked;
        self.sensor.streams = true;
        self.streamed_at = Some(self.baud);
        let silent_at = self.silent_at(now);
        // A reply that is under way may answer; half a request must be forgotten before the next one.
        let unsaid = self.open.take_if(|open| !open.is_out());
        let ask_at = if unsaid.is_some_and(|open| open.is_partly_out()) { now + FORGOTTEN } else { now };
        self.phase = Phase::Streaming { header, silent_at, questions: QUESTIONS, rounds: 0, ask_at };
        self.question(now);
    }

    /// Right after a scan: asks for what a stream does not tell. A reply costs the scan that it interrupts, so the next
    /// question waits for the next scan.
    fn question(&mut self, now: Nanos) {
        let Phase::Streaming { questions, rounds, ask_at, .. } = &mut self.phase else { return };
        if self.open.is_some() || now < *ask_at {
            return;
        }
        let sensor = &self.sensor;
        let is_open = |question: Request| match question {
            Request::Type => sensor.kind().is_empty(),
            Request::Status => sensor.defective.is_none() || sensor.is_complaint_open(),
            _ => sensor.mode.is_none(),
        };
        while let Some((&question, rest)) = questions.split_first() {
            *questions = rest;
            if is_open(question) {
                return self.ask(question, now, 1);
            }
        }
        let mode_is_known = sensor.mode.is_some();
        if QUESTIONS.iter().any(|&question| is_open(question)) && *rounds < QUESTION_ROUNDS - 1 {
            *rounds += 1;
            *questions = QUESTIONS;
        } else if mode_is_known {
            *ask_at = Nanos::MAX;
            self.sensor.believe();
            self.trouble = self.trouble.filter(|&trouble| trouble != Trouble::ModeUnknown);
        } else {
            *ask_at = now + QUESTION_PAUSE;
            *questions = QUESTIONS;
            self.trouble = Some(Trouble::ModeUnknown);
        }
    }

    pub(crate) fn ask(&mut self, request: Request, not_before: Nanos, tries: u8) {
        self.recalled = None;
        let address = self.sensor.address.map_or(0, |address| address & !REPLY);
        // What the sensor has half heard must be forgotten first.
        let is_cut = self.open.as_ref().is_some_and(Outgoing::is_partly_out);
        let not_before = if is_cut { not_before + FORGOTTEN } else { not_before };
        self.open = Some(Outgoing::new(request, address, not_before, tries));
    }

    /// Uses 38,400 baud in place of 500,000 baud from now on if the line cannot carry that rate. Returns whether it does so.
    pub(crate) fn limit_rate(&mut self) -> bool {
        let Settings { baud, keep_baud, listen_only, fixed_rate, .. } = self.settings;
        let is_limited =
            self.fast_switches.have_failed() && baud == FAST && !(keep_baud || listen_only || fixed_rate);
        if is_limited {
            self.settings.baud = RS232;
        }
        is_limited
    }

    /// Returns the rate that is used in place of 500,000 baud, if the line cannot carry that rate.
    pub(crate) fn rate_in_place_of_fast(&self) -> Option<Baud> {
        Some(self.settings.baud).filter(|&baud| baud != self.wanted)
    }

    pub(crate) fn change_baud(&mut self, baud: Baud) {
        if self.baud != baud && !self.settings.fixed_rate {
            self.baud = baud;
            self.change_baud = Some(baud);
        }
    }
}

/// The rate that needs RS-422.
pub(crate) const FAST: Baud = Baud::B500000;
/// The highest rate of RS-232.
const RS232: Baud = Baud::B38400;
/// Command byte of the reply to every change of mode or rate.
const MODE_REPLY: u8 = MODE | REPLY;
