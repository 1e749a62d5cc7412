//! Finds a sensor whose rate is not known: first by listening, then by a request at one rate after the other, in
//! rounds that become rarer while the line is dead. [`crate::lms::dialogue`] handles what the sensor answers.

use crate::line::State;
use crate::lms::command::Request;
use crate::lms::dialogue::Dialogue;
use crate::lms::phase::{LISTEN, PATIENCE, PAUSE_ROUNDS, PAUSES, Phase, QUIET, SETTLE};
use crate::lms::sensor::Trouble;
use crate::lms::variant::Baud;
use schema::{MILLIS, Nanos};

impl Dialogue {
    /// Starts like a new session: listens at the wanted rate and sends nothing.
    pub(crate) fn begin(&mut self, now: Nanos) {
        self.first = self.rest_at;
        if core::mem::take(&mut self.is_paused) {
            // A sensor that gets no request does not answer.
            self.quiet_since = now;
            // It was stopped at this rate.
            self.first = self.settings.baud;
        }
        self.trouble = None;
        self.variant_refused = false;
        self.sensor.forget();
        self.change_baud(self.settings.baud);
        self.listen(now, State::Probing);
    }

    /// Starts at `baud`, at which a search has found the scanner and the port is open.
    pub(crate) fn begin_at(&mut self, baud: Baud, now: Nanos) {
        (self.rest_at, self.first) = (baud, baud);
        (self.baud, self.change_baud) = (baud, None);
        self.listen(now, State::Probing);
    }

    /// Listens for a stream at this rate.
    pub(crate) fn listen(&mut self, now: Nanos, shown: State) {
        self.open = None;
        self.heard = false;
        let give_up_at = now + LISTEN.max(2 * self.period());
        // A stream that fell silent may go on, and bytes from a network come in lumps.
        let may_pause = shown == State::Silent || self.settings.fixed_rate;
        let quiet_at = if may_pause { give_up_at } else { now + QUIET };
        self.phase = Phase::Listening { give_up_at, quiet_at, shown, attempt: 0 };
    }

    /// Asks who is there at the rate that has its turn. At another rate than the wanted one, if the line is silent, for its
    /// type: at 9600 the 160 bytes of a status take 0.17 s, and it is asked anyway once the rate is changed. In every
    /// other round for the status, for those who do not tell their type.
    pub(crate) fn probe(&mut self, now: Nanos, attempt: usize) {
        self.phase = Phase::Probing { attempt };
        // Who answers next may be another sensor: address 0 is for all.
        self.sensor.address = None;
        let (round, turn) = (attempt / ORDER.len(), attempt % ORDER.len());
        let wanted = self.settings.baud;
        let baud = self.rate_of(turn);
        let is_patient = round % 2 == 1;
        let is_fixed = self.settings.fixed_rate;
        let is_brief = baud != wanted && !is_patient && !self.heard && !self.is_paused && !is_fixed;
        let not_before = if baud == self.baud { now } else { now + SETTLE };
        self.change_baud(baud);
        self.ask(if is_brief { Request::Type } else { Request::Status }, not_before, 1);
        if let Some(open) = self.open.as_mut().filter(|_| is_patient) {
            open.be_patient(PATIENCE);
        }
    }

    /// Which rate has this turn in a round: the likeliest, the wanted one, the others.
    fn rate_of(&self, turn: usize) -> Baud {
        let (first, wanted) = (self.first, self.settings.baud);
        let second = (first != wanted).then_some(wanted);
        let others = ORDER.into_iter().filter(|&baud| baud != first && baud != wanted);
        [first].into_iter().chain(second).chain(others).nth(turn).unwrap_or(wanted)
    }

    /// Nobody answered `attempt`. A round without a single byte is followed by a pause at the rate at which a sensor
    /// says that it has power, which takes it up to a minute (Telegram listing 7.1).
    pub(crate) fn search_on(&mut self, attempt: usize, now: Nanos) {
        let next = attempt + 1;
        if !next.is_multiple_of(ORDER.len()) {
            return self.probe(now, next);
        }
        let round = next / ORDER.len();
        if self.is_paused && round == PAUSE_ROUNDS {
            return self.nobody_to_stop();
        }
        let baud = self.settings.fixed_rate.then_some(self.baud);
        let seconds = coarse(now.saturating_sub(self.quiet_since) / (1_000 * MILLIS));
        if !self.is_paused && seconds > 0 && !self.fast_switches.have_lost() {
            self.trouble = Some(Trouble::NoAnswer { baud, seconds });
        }
        let pause = PAUSES[(round - 1).min(PAUSES.len() - 1)];
        if core::mem::take(&mut self.heard) || pause == 0 {
            return self.probe(now, next);
        }
        self.change_baud(POWER_ON_BAUD);
        let until = now + pause;
        self.phase =
            Phase::Listening { give_up_at: until, quiet_at: until, shown: State::Probing, attempt: next };
    }
}

/// Seconds as they are reported: in coarse steps, so that the report does not change every second.
fn coarse(seconds: u64) -> u32 {
    let step = STEPS.into_iter().rev().find(|&step| u64::from(step) <= seconds).unwrap_or(0);
    if step < HOUR { step } else { (seconds / u64::from(HOUR)) as u32 * HOUR }
}

/// The rates after the wanted one, likeliest first: power-on, what a hub leaves behind, what is left.
const ORDER: [Baud; 4] = [Baud::B9600, Baud::B500000, Baud::B38400, Baud::B19200];
/// Without another setting in its EEPROM a sensor begins at this rate.
pub(crate) const POWER_ON_BAUD: Baud = Baud::B9600;
const HOUR: u32 = 3_600;
const STEPS: [u32; 9] = [1, 3, 10, 30, 60, 300, 600, 1_800, HOUR];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_is_told_in_few_words() {
        let told = [0, 1, 2, 9, 59, 60, 299, 3_599, 3_600, 7_199, 7_200, 360_000].map(coarse);
        assert_eq!(told, [0, 1, 1, 3, 30, 60, 60, 1_800, 3_600, 3_600, 7_200, 360_000]);
    }
}
