//! One topic of one sensor, sample by sample, with a count of missed samples. Continues by itself when the hub is
//! replaced. Never waits: the session does that.

use std::ops::Deref;
use std::time::{Duration, Instant};

use scanhub_schema::{Failure, Header, Kind, Scan};
use scanhub_shm::{Payload, ReceiveError, Sample, Subscriber};

use crate::numbers::{Noted, Numbers};
use crate::session::Session;

/// A sample in shared memory: `*` gives the payload, read-only, without a copy. Hold at most four at a time, and none
/// during a wait.
#[derive(Debug)]
pub struct Received<P: Payload + ?Sized> {
    sample: Sample<P>,
    /// Samples of this topic that were sent before this one and not received.
    pub missed: u64,
    /// The hub was restarted since the last sample: its numbers start again at 0.
    pub restarted: bool,
}

impl<P: Payload + ?Sized> Received<P> {
    /// Returns numbers, stamps and quality of the sample.
    pub fn header(&self) -> &Header {
        self.sample.user_header()
    }
}

impl<P: Payload + ?Sized> Deref for Received<P> {
    type Target = P;

    fn deref(&self) -> &P {
        P::read(&self.sample)
    }
}

impl Received<Scan> {
    /// Returns CLOCK_MONOTONIC when beam `i` was measured, in ns: stamps are of bytes on the wire, the measurement is older.
    pub fn beam_time_ns(&self, i: usize) -> u64 {
        self.header().stamp_first_ns.saturating_add_signed(self.beam_ns(i))
    }
}

/// Follows one topic, also across restarts of the hub.
pub struct Follower<P: Payload + ?Sized> {
    sensor: String,
    port: Option<(u32, Subscriber<P>)>,
    asked_at: Option<Instant>,
    numbers: Numbers,
    unconnected_since: Option<Instant>,
    /// In this moment there was nothing.
    nothing_at: Option<(u32, Instant)>,
}

/// How often a topic that is not there is asked for.
const ASK_EVERY: Duration = Duration::from_millis(50);

/// A publisher that cannot be connected to for this long is not just dying.
const UNCONNECTED_LIMIT: Duration = Duration::from_secs(3);

impl<P: Payload + ?Sized> Follower<P> {
    /// Makes what will follow the topic of `sensor`, as soon as it is there.
    pub fn new(sensor: &str) -> Follower<P> {
        Follower {
            sensor: sensor.to_owned(),
            port: None,
            asked_at: None,
            numbers: Numbers::default(),
            unconnected_since: None,
            nothing_at: None,
        }
    }

    /// Returns whether the topic has been there at least once.
    pub fn subscribed(&self) -> bool {
        self.port.is_some()
    }

    /// Returns the next sample that waits, or nothing.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`] if descriptors or memory are short, [`Kind::Failed`] if more than four samples are held or the
    /// topic has another layout.
    pub fn receive(&mut self, session: &mut Session) -> Result<Option<Received<P>>, Failure> {
        if !self.subscribe(session)? {
            return Ok(None);
        }
        let Some((_, subscriber)) = &self.port else {
            return Ok(None);
        };
        let moment = session.moment(&self.sensor, P::TOPIC);
        if moment.is_some() && moment == self.nothing_at {
            return Ok(None);
        }
        match P::receive(subscriber) {
            Ok(sample) => {
                self.unconnected_since = None;
                self.nothing_at = moment.filter(|_| sample.is_none());
                Ok(sample.map(|sample| self.account(sample)))
            }
            Err(ReceiveError::ExceedsMaxBorrows) => Err(Failure::new(
                Kind::Failed,
                "more than four samples are held",
                "drop them before the next one",
            )),
            // Seen while a killed hub's memory is being removed; what stays so is a shortage.
            Err(ReceiveError::ConnectionFailure(error)) => {
                let since = *self.unconnected_since.get_or_insert_with(Instant::now);
                if since.elapsed() < UNCONNECTED_LIMIT {
                    return Ok(None);
                }
                let what = format!("cannot connect to {}/{}: {error:?}", self.sensor, P::TOPIC.name());
                Err(Failure::new(Kind::Short, what, "`ulimit -n` or /dev/shm may be too small"))
            }
        }
    }

    fn subscribe(&mut self, session: &mut Session) -> Result<bool, Failure> {
        if self.port.as_ref().is_some_and(|(number, _)| *number == session.number()) {
            return Ok(true);
        }
        if self.asked_at.is_some_and(|at| at.elapsed() < ASK_EVERY) {
            return Ok(false);
        }
        self.asked_at = Some(Instant::now());
        let Some(subscriber) = session.subscribe::<P>(&self.sensor)? else {
            return Ok(false);
        };
        self.port = Some((session.number(), subscriber));
        self.numbers.begin_anew();
        self.nothing_at = None;
        Ok(true)
    }

    fn account(&mut self, sample: Sample<P>) -> Received<P> {
        let Noted { missed, restarted } = self.numbers.note(sample.user_header());
        Received { sample, missed, restarted }
    }
}
