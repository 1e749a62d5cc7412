//! Reader of one topic of one sensor. It receives sample by sample, and counts missed samples by their sequence
//! numbers. It continues when the hub is replaced. It never waits. Waiting is up to the session.

use std::mem;
use std::ops::Deref;
use std::time::{Duration, Instant};

use scanhub_schema::{Flags, Header, Kind, Scan};
use scanhub_shm::{Payload, ReceiveError, Sample, Subscriber, ThreadSafeService};

use crate::error::{Error, ErrorKind};
use crate::session::Session;
use crate::silence::{Silence, SilenceCheck};

/// Sample in shared memory. `*` returns the payload, read-only and without a copy. Hold at most four samples of a
/// subscriber at a time. The samples stay valid while the subscriber waits, and after the hub has ended.
#[derive(Debug)]
pub struct Received<P: Payload + ?Sized> {
    sample: Sample<P, ThreadSafeService>,
    /// Number of samples of this topic that were sent before this one and not received.
    pub missed: u64,
    /// Whether the hub was restarted since the last sample, so that its sequence numbers start again at 0.
    pub restarted: bool,
}

impl<P: Payload + ?Sized> Received<P> {
    /// Returns the header, with numbers, stamps and quality of the sample.
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
    /// Returns the time at which beam `i` was measured, in ns of CLOCK_MONOTONIC. That time is earlier than the
    /// sample's stamps, which are the times of bytes on the line.
    pub fn beam_time_ns(&self, i: usize) -> u64 {
        self.header().stamp_first_ns.saturating_add_signed(self.beam_ns(i))
    }
}

/// Reader of one topic, which continues across restarts of the hub.
pub struct TopicReader<P: Payload + ?Sized> {
    sensor: String,
    port: Option<(u32, Subscriber<P, ThreadSafeService>)>,
    tried_at: Option<Instant>,
    /// Reason why the last attempt to subscribe found no slot, memory or descriptor.
    refused: Option<Error>,
    sequence: SequenceTracker,
    unconnected_since: Option<Instant>,
    /// Value of [`Session::sample_mark`] when no sample was waiting. While it stays the same, none has arrived.
    empty_at: Option<(u32, Instant)>,
    silence: SilenceCheck,
}

/// Interval between attempts to open a topic that does not exist yet.
const RETRY_INTERVAL: Duration = Duration::from_millis(50);

/// Time after which a failure to connect to a publisher is reported. While a hub exits, such failures are normal.
const CONNECTION_FAILURE_TIMEOUT: Duration = Duration::from_secs(3);

impl<P: Payload + ?Sized> TopicReader<P> {
    /// Creates a reader of the topic of `sensor`, which may not exist yet.
    pub fn new(sensor: &str) -> TopicReader<P> {
        TopicReader {
            sensor: sensor.to_owned(),
            port: None,
            tried_at: None,
            refused: None,
            sequence: SequenceTracker::default(),
            unconnected_since: None,
            empty_at: None,
            silence: SilenceCheck::default(),
        }
    }

    /// Returns whether the topic has existed at least once.
    pub fn subscribed(&self) -> bool {
        self.port.is_some()
    }

    /// Returns why no sample arrives. This method never waits, and is cheap enough to be called once a second. The
    /// first call after a sample can return [`Silence::Waiting`], because the method has just subscribed to the status
    /// of the sensor.
    pub fn why_silent(&mut self, session: &mut Session) -> Silence {
        let mut silence = mem::take(&mut self.silence);
        let reason = silence.reason(session, self);
        self.silence = silence;
        reason
    }

    pub(crate) fn sensor(&self) -> &str {
        &self.sensor
    }

    /// Returns whether the reader is subscribed to the topic of the session's current hub.
    pub(crate) fn is_attached(&self, session: &Session) -> bool {
        self.port.as_ref().is_some_and(|(number, _)| *number == session.join_count())
    }

    /// Returns the reason why the last attempt to subscribe found no slot, memory or descriptor.
    pub(crate) fn refused(&self) -> Option<&Error> {
        self.refused.as_ref()
    }

    /// Returns the next sample that has arrived.
    ///
    /// # Errors
    ///
    /// [`Error::TooManyHeld`] if the program holds four samples and another one has arrived,
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if descriptors or memory are short,
    /// [`ErrorKind::Incompatible`](crate::ErrorKind) if the topic has another layout.
    pub fn receive(&mut self, session: &mut Session) -> Result<Option<Received<P>>, Error> {
        let received = self.receive_quietly(session)?;
        if received.is_some() {
            session.note_sample();
            self.silence = SilenceCheck::default();
        }
        Ok(received)
    }

    /// Returns the next sample that has arrived, but does not count it as the end of a silence.
    pub(crate) fn receive_quietly(&mut self, session: &mut Session) -> Result<Option<Received<P>>, Error> {
        if !self.subscribe(session)? {
            return Ok(None);
        }
        let Some((_, subscriber)) = &self.port else {
            return Ok(None);
        };
        let mark = session.sample_mark(&self.sensor, P::TOPIC);
        if mark.is_some() && mark == self.empty_at {
            return Ok(None);
        }
        match P::receive(subscriber) {
            Ok(sample) => {
                self.unconnected_since = None;
                self.empty_at = mark.filter(|_| sample.is_none());
                Ok(sample.map(|sample| self.count(sample)))
            }
            Err(ReceiveError::ExceedsMaxBorrows) => Err(Error::TooManyHeld),
            // This error occurs while the memory of a killed hub is being removed. If it persists, descriptors or
            // memory are short.
            Err(ReceiveError::ConnectionFailure(error)) => {
                let since = *self.unconnected_since.get_or_insert_with(Instant::now);
                if since.elapsed() < CONNECTION_FAILURE_TIMEOUT {
                    return Ok(None);
                }
                let what = format!("cannot connect to {}/{}: {error:?}", self.sensor, P::TOPIC.name());
                Err(Error::new(Kind::ResourceExhausted, what, "`ulimit -n` or /dev/shm may be too small"))
            }
        }
    }

    fn subscribe(&mut self, session: &mut Session) -> Result<bool, Error> {
        if self.is_attached(session) {
            return Ok(true);
        }
        if self.tried_at.is_some_and(|at| at.elapsed() < RETRY_INTERVAL) {
            return Ok(false);
        }
        self.tried_at = Some(Instant::now());
        let subscriber = session.subscribe::<P>(&self.sensor);
        self.refused = match &subscriber {
            Err(error) if error.kind() == ErrorKind::ResourceExhausted => Some(error.clone()),
            _ => None,
        };
        let Some(subscriber) = subscriber? else {
            return Ok(false);
        };
        self.port = Some((session.join_count(), subscriber));
        self.sequence.reset();
        self.empty_at = None;
        Ok(true)
    }

    fn count(&mut self, sample: Sample<P, ThreadSafeService>) -> Received<P> {
        let SequenceGap { missed, restarted } = self.sequence.note(sample.user_header());
        Received { sample, missed, restarted }
    }
}

/// Sequence numbers of one topic of one sensor, as one subscriber receives them.
#[derive(Clone, Debug, Default)]
pub struct SequenceTracker {
    boot: Option<u64>,
    expected: Option<u64>,
}

/// Result of comparing the sequence number of a sample with the previous one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SequenceGap {
    /// Number of samples of this topic that were sent before this one and not received.
    pub missed: u64,
    /// Whether the hub was restarted since the last sample, so that its sequence numbers start again at 0.
    pub restarted: bool,
}

impl SequenceTracker {
    /// Accepts any sequence number of the next sample without counting missed samples, because the port is new.
    pub fn reset(&mut self) {
        self.expected = None;
    }

    /// Compares the sequence number in `header` with that of the previous sample. A port that was open before the hub
    /// started receives the hub's samples from number 0. A new port starts at any number.
    pub fn note(&mut self, header: &Header) -> SequenceGap {
        let restarted = self.boot.is_some_and(|boot| boot != header.boot);
        // Numbers of remote topics continue when the hub on the other machine restarts.
        let is_remote = header.flags & Flags::REMOTE != 0;
        if restarted && !is_remote && self.expected.is_some() {
            self.expected = Some(0);
        }
        let missed = self.expected.map_or(0, |expected| header.topic_seq.saturating_sub(expected));
        self.boot = Some(header.boot);
        self.expected = Some(header.topic_seq + 1);
        SequenceGap { missed, restarted }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_gaps_and_expects_0_after_a_hub_restart() {
        let mut numbers = SequenceTracker::default();
        let mut note = |boot, topic_seq, flags| {
            let SequenceGap { missed, restarted } =
                numbers.note(&Header { boot, topic_seq, flags, ..Header::default() });
            (missed, restarted)
        };
        assert_eq!((note(1, 7, 0), note(1, 8, 0), note(1, 11, 0)), ((0, false), (0, false), (2, false)));
        assert_eq!((note(2, 3, 0), note(2, 4, 0)), ((3, true), (0, false)));
        assert_eq!(note(3, 9, Flags::REMOTE), (4, true), "a network's numbers go on");
        numbers.reset();
        let later = Header { boot: 3, topic_seq: 50, ..Header::default() };
        assert_eq!(numbers.note(&later), SequenceGap { missed: 0, restarted: false });
    }
}
