//! What to say to the sensor next: from a line of unknown rate to a stream, and back when the stream ends. Knows
//! telegrams and deadlines, no bytes and no port. It never says anything that outlives a power cycle.

use crate::Nanos;
use crate::command::Request;
use crate::header::Expect;
use crate::measured::Measured;
use crate::outgoing::{FORGOTTEN, NAK_PAUSE, Outgoing};
use crate::phase::{
    BESIDE_VALUES, Control, LISTEN, PAUSE, Phase, QUESTIONS, Reason, SETTLE, SILENCE, STOPS, Settings, Step,
    TRIES,
};
use crate::reply::Reply;
use crate::sensor::{Sensor, State, Trouble};
use crate::telegram::{REPLY, Telegram};
use crate::variant::Baud;

#[derive(Clone, Debug)]
pub(crate) struct Dialogue {
    pub(crate) settings: Settings,
    phase: Phase,
    open: Option<Outgoing>,
    change_baud: Option<Baud>,
    pub(crate) baud: Baud,
    pub(crate) sensor: Sensor,
    pub(crate) trouble: Option<Trouble>,
    pub(crate) resyncs: u64,
}

impl Dialogue {
    pub(crate) fn new(settings: Settings, now: Nanos) -> Self {
        let phase = if settings.listen_only {
            Phase::Following
        } else {
            Phase::Listening { give_up_at: now, shown: State::Probing }
        };
        let mut dialogue = Dialogue {
            settings,
            phase,
            open: None,
            change_baud: None,
            baud: settings.baud,
            sensor: Sensor::default(),
            trouble: None,
            resyncs: 0,
        };
        if !settings.listen_only {
            dialogue.listen(now, State::Probing);
        }
        dialogue
    }

    pub(crate) fn state(&self) -> State {
        match self.phase {
            Phase::Listening { shown, .. } => shown,
            Phase::Probing { .. } => State::Probing,
            Phase::Switching => State::Switching,
            Phase::Starting { .. } => State::Starting,
            Phase::Streaming { .. } | Phase::Following => State::Streaming,
            Phase::Paused { .. } => State::Paused,
        }
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

    /// Which headers may come.
    pub(crate) fn expect(&self) -> Expect {
        match self.phase {
            Phase::Streaming { header, .. } => {
                Expect::Stream { header, reply: self.open.as_ref().map(Outgoing::reply) }
            }
            _ => Expect::Anything,
        }
    }

    pub(crate) fn deadline(&self) -> (Nanos, Reason) {
        let reply = self.open.as_ref().map_or(Nanos::MAX, Outgoing::give_up_at);
        let (own, reason) = match self.phase {
            Phase::Listening { give_up_at, .. } => (give_up_at, Reason::Listening),
            Phase::Streaming { silent_at, .. } => (silent_at, Reason::Silence),
            _ => (Nanos::MAX, Reason::Never),
        };
        let request =
            self.open.as_ref().and_then(Outgoing::byte).map_or(Nanos::MAX, |(_, not_before)| not_before);
        [(reply, Reason::Reply), (request, Reason::Request)]
            .into_iter()
            .fold((own, reason), |a, b| if b.0 < a.0 { b } else { a })
    }

    pub(crate) fn handle_timeout(&mut self, now: Nanos) {
        match self.phase {
            Phase::Listening { give_up_at, .. } if now >= give_up_at => return self.probe(now, 0),
            Phase::Streaming { silent_at, .. } if now >= silent_at => {
                self.resyncs += 1;
                self.trouble = Some(Trouble::Silence);
                return self.listen(now, State::Silent);
            }
            _ => {}
        }
        if self.open.as_ref().is_some_and(|open| now >= open.give_up_at()) {
            self.retry(now);
        }
    }

    pub(crate) fn control(&mut self, control: Control, now: Nanos) {
        match (control, self.phase) {
            (_, Phase::Following) | (Control::Pause, Phase::Paused { .. }) => {}
            (Control::Pause, _) => {
                self.phase = Phase::Paused { stops_left: STOPS };
                self.trouble = None;
                self.ask(Request::Stop, now, TRIES);
            }
            (Control::Resume, Phase::Paused { .. }) => self.begin(now),
            (Control::Resync, _) => {
                self.resyncs += 1;
                self.begin(now);
            }
            (Control::Resume, _) => {}
        }
    }

    pub(crate) fn on_acknowledge(&mut self, now: Nanos) {
        let baud = self.baud;
        if let Some(open) = self.open.as_mut().filter(|open| open.is_out()) {
            open.acknowledged(now, baud);
        }
    }

    /// While the rate is sought, a NAK proves nothing: the scan that the request broke off, or a stream at another
    /// rate, has such bytes, and who believes them leaves the right rate. Then only time says no.
    pub(crate) fn on_nak(&mut self, now: Nanos) {
        if !matches!(self.phase, Phase::Probing { .. }) && self.open.as_ref().is_some_and(Outgoing::is_out) {
            self.retry(now + NAK_PAUSE);
        }
    }

    pub(crate) fn on_telegram(&mut self, telegram: Telegram<'_>, now: Nanos) {
        // What cannot be read is an answer all the same.
        let reply = Reply::decode(telegram);
        if let Some(reply) = &reply {
            self.sensor.learn(reply, telegram);
        }
        if let Some(Reply::Measured(measured)) = reply {
            return self.on_measured(telegram, measured, now);
        }
        let expected = telegram.command() == crate::reply::REFUSED
            || self.open.as_ref().is_some_and(|open| open.reply() == telegram.command());
        if let Some(open) = self.open.take_if(|open| expected && open.is_out()) {
            self.on_reply(open.request, reply, now);
        }
    }

    fn on_measured(&mut self, telegram: Telegram<'_>, measured: Measured<'_>, now: Nanos) {
        let silent_at = self.silent_at(now);
        match self.phase {
            Phase::Streaming { silent_at: ref mut at, .. } => *at = silent_at,
            Phase::Following => {}
            Phase::Paused { ref mut stops_left } => {
                if self.open.is_none() && *stops_left > 0 {
                    *stops_left -= 1;
                    self.ask(Request::Stop, now, TRIES);
                }
            }
            Phase::Listening { .. } | Phase::Probing { .. } if self.baud != self.settings.baud => {
                self.sensor.streams = true;
                self.switch(now);
            }
            Phase::Listening { .. } | Phase::Probing { .. } if !self.is_wanted(measured) => {
                self.sensor.streams = true;
                self.start(Step::Stop, now);
            }
            Phase::Listening { .. } | Phase::Probing { .. } => self.stream(telegram, now),
            Phase::Starting { step: Step::Stream } if self.open.as_ref().is_none_or(Outgoing::is_out) => {
                self.stream(telegram, now);
            }
            Phase::Switching | Phase::Starting { .. } => {}
        }
    }

    /// Whether a running stream has the beams asked for; a sensor that refused them is taken as it is.
    fn is_wanted(&self, measured: Measured<'_>) -> bool {
        let same = measured.count() == self.settings.variant.beams();
        measured.partial().is_none() && (same || self.trouble == Some(Trouble::VariantRefused))
    }

    /// Time between two telegrams of the variant asked for.
    fn period(&self) -> Nanos {
        let Settings { variant, baud, .. } = self.settings;
        variant.period(2 * variant.beams() + BESIDE_VALUES, baud.rate())
    }

    fn on_reply(&mut self, request: Request, reply: Option<Reply<'_>>, now: Nanos) {
        match (self.phase, request) {
            (Phase::Probing { .. }, _) if self.baud == self.settings.baud => self.start(Step::Stop, now),
            (Phase::Probing { .. }, _) => self.switch(now),
            (Phase::Switching, Request::Stop) => {
                self.sensor.streams = false;
                self.switch(now);
            }
            (Phase::Switching, Request::Baud(baud)) if reply == Some(Reply::Mode { done: true }) => {
                self.change_baud(baud);
                self.start(Step::Stop, now + SETTLE);
            }
            (Phase::Starting { step }, _) => {
                if step == Step::Variant && !matches!(reply, Some(Reply::Variant { done: true, .. })) {
                    self.trouble = Some(Trouble::VariantRefused);
                }
                let failed = matches!(reply, Some(Reply::Refused | Reply::Mode { done: false }));
                match step {
                    Step::Stop | Step::Stream if failed => {
                        self.trouble = Some(Trouble::Refused(request));
                        self.probe(now + PAUSE, 0);
                    }
                    // The stream is there when its first telegram is; until then its request stays unrepeated.
                    Step::Stream => self.await_stream(now),
                    Step::Stop => {
                        self.sensor.streams = false;
                        self.start(Step::Variant, now);
                    }
                    Step::Variant => self.start(Step::Type, now),
                    Step::Type => self.start(Step::Configuration, now),
                    Step::Configuration => self.start(Step::Stream, now),
                }
            }
            (Phase::Streaming { .. }, _) => self.question(now),
            (Phase::Paused { .. }, _) => self.sensor.streams = false,
            _ => {
                self.trouble = Some(Trouble::Refused(request));
                self.probe(now + PAUSE, 0);
            }
        }
    }

    /// No reply to the open request: again, or on without it.
    fn retry(&mut self, at: Nanos) {
        let Some(open) = &mut self.open else { return };
        let request = open.request;
        if open.again(at) {
            return;
        }
        self.open = None;
        match self.phase {
            Phase::Probing { attempt } => {
                if attempt % Baud::ALL.len() == Baud::ALL.len() - 1 {
                    self.trouble = Some(Trouble::NoAnswer);
                }
                self.probe(at, attempt + 1);
            }
            // Some sensors do not have it, some do not answer these right after a reset: the stream matters more.
            Phase::Starting { step: Step::Variant } => {
                self.trouble = Some(Trouble::VariantRefused);
                self.start(Step::Type, at);
            }
            Phase::Starting { step: Step::Type } => self.start(Step::Configuration, at),
            Phase::Starting { step: Step::Configuration } => self.start(Step::Stream, at),
            Phase::Streaming { .. } => self.question(at),
            Phase::Paused { .. } => {}
            _ => {
                self.trouble = Some(Trouble::Unanswered(request));
                self.probe(at, 0);
            }
        }
    }

    /// As a new session does: at the wanted rate, without a word.
    fn begin(&mut self, now: Nanos) {
        self.trouble = None;
        self.change_baud(self.settings.baud);
        self.listen(now, State::Probing);
    }

    fn listen(&mut self, now: Nanos, shown: State) {
        self.open = None;
        self.phase = Phase::Listening { give_up_at: now + LISTEN.max(2 * self.period()), shown };
    }

    /// Until when measured data may stay out: the paper's second, and on a slow line two telegrams' worth.
    fn silent_at(&self, now: Nanos) -> Nanos {
        now + SILENCE.max(5 * self.period() / 2)
    }

    fn probe(&mut self, now: Nanos, attempt: usize) {
        self.phase = Phase::Probing { attempt };
        // Who answers next may be another sensor: address 0 is for all.
        self.sensor.address = None;
        let wanted = self.settings.baud;
        let mut others = Baud::ALL.into_iter().filter(|&baud| baud != wanted);
        let turn = if self.settings.fixed_rate { 0 } else { attempt % Baud::ALL.len() };
        let baud = if turn == 0 { wanted } else { others.nth(turn - 1).unwrap_or(wanted) };
        self.change_baud(baud);
        self.ask(Request::Status, now + SETTLE, 1);
    }

    fn switch(&mut self, now: Nanos) {
        self.phase = Phase::Switching;
        let request = if self.sensor.streams { Request::Stop } else { Request::Baud(self.settings.baud) };
        self.ask(request, now, TRIES);
    }

    /// Begins with `step`, or the first one after it that has something to say.
    fn start(&mut self, step: Step, now: Nanos) {
        let same_variant = self.sensor.variant == Some(self.settings.variant);
        let (step, request) = match step {
            Step::Stop if self.sensor.streams => (step, Request::Stop),
            Step::Stop | Step::Variant if !same_variant => {
                (Step::Variant, Request::Variant(self.settings.variant))
            }
            Step::Stop | Step::Variant | Step::Type => (Step::Type, Request::Type),
            Step::Configuration => (step, Request::Configuration),
            Step::Stream => (step, Request::Stream),
        };
        self.phase = Phase::Starting { step };
        self.ask(request, now, TRIES);
    }

    /// The sensor said that it streams: the first telegram is due like one that went missing.
    fn await_stream(&mut self, now: Nanos) {
        self.phase = Phase::Listening { give_up_at: self.silent_at(now), shown: State::Starting };
    }

    fn stream(&mut self, telegram: Telegram<'_>, now: Nanos) {
        if let Some(&header) = telegram.bytes().first_chunk() {
            self.sensor.streams = true;
            self.trouble = self.trouble.filter(|&trouble| trouble == Trouble::VariantRefused);
            self.open = None;
            self.phase = Phase::Streaming { header, silent_at: self.silent_at(now), questions: QUESTIONS };
            self.question(now);
        }
    }

    /// Asks an adopted sensor for what its stream does not tell. Each reply costs the scan that it interrupts.
    fn question(&mut self, now: Nanos) {
        let Phase::Streaming { questions, .. } = &mut self.phase else { return };
        while let Some((&question, rest)) = questions.split_first() {
            *questions = rest;
            let is_known = match question {
                Request::Type => !self.sensor.kind().is_empty(),
                _ => self.sensor.mode.is_some(),
            };
            if !is_known {
                return self.ask(question, now, TRIES);
            }
        }
        if self.sensor.mode.is_none() {
            self.trouble = Some(Trouble::ModeUnknown);
        }
    }

    fn ask(&mut self, request: Request, not_before: Nanos, tries: u8) {
        let address = self.sensor.address.map_or(0, |address| address & !REPLY);
        // What the sensor has half heard must be forgotten first.
        let is_cut = self.open.as_ref().is_some_and(Outgoing::is_partly_out);
        let not_before = if is_cut { not_before + FORGOTTEN } else { not_before };
        self.open = Some(Outgoing::new(request, address, not_before, tries));
    }

    fn change_baud(&mut self, baud: Baud) {
        if self.baud != baud {
            self.baud = baud;
            self.change_baud = Some(baud);
        }
    }
}
