//! The session with one scanner as its driver sees it: bytes and the time go in, bytes, what arrived and the next deadline
//! come out. It never waits, reads or writes itself. Refuses to know what the bytes say: that is the family's.

use core::fmt;

use schema::Nanos;

/// A conversation with a scanner that goes on as long as the line is open. After every call that changes it, drain
/// [`Session::poll_output`] until it answers [`Output::Wait`] or [`Output::Rest`].
pub trait Session {
    /// What it hands out, in its own buffer.
    type Heard<'a>
    where
        Self: 'a;
    /// Why it is not where it should be; shown, it is said in words.
    type Trouble: Copy + PartialEq + fmt::Display;

    /// Room for the next read; never empty once the outputs are drained.
    fn spare(&mut self) -> &mut [u8];

    /// A read returned at `now` and brought `len` bytes into [`Session::spare`].
    fn commit(&mut self, now: Nanos, len: usize);

    /// Whether it is worth a look how many bytes the line has, to [`leave`](Self::leave) them there.
    fn may_leave(&self) -> bool {
        false
    }

    /// The line has `waiting` bytes at `now` that were not read. Whether they may stay there for a while: what a host has
    /// not read, one that is killed does not lose.
    fn leave(&mut self, now: Nanos, waiting: usize) -> bool {
        let _ = (now, waiting);
        false
    }

    /// The deadline passed, and a read found nothing.
    fn handle_timeout(&mut self, now: Nanos);

    /// A user wants this from now on. Asking twice changes nothing, but a [`Control::Resync`] counts each time. A
    /// recording cannot be controlled.
    fn control(&mut self, control: Control, now: Nanos);

    /// Whether anybody follows what it hands out, as it is at `now`: a scanner may rest while nobody does.
    fn followed(&mut self, now: Nanos, is_followed: bool) {
        let _ = (now, is_followed);
    }

    /// The line is closed in a moment, and nobody comes after it. Whether there is something to write before: to be drained
    /// once more then.
    fn end(&mut self, now: Nanos) -> bool {
        let _ = now;
        false
    }

    /// The byte of [`Output::Transmit`] was written at `now`.
    fn transmitted(&mut self, now: Nanos);

    /// What the session wants next.
    fn poll_output(&mut self) -> Output<Self::Heard<'_>>;

    /// How far it is.
    fn state(&self) -> State;

    /// Why it is not where it should be; nothing if it is.
    fn trouble(&self) -> Option<Self::Trouble>;

    /// Returns the name of the transmissions that the session misses, such as `LMS replies`, while its
    /// [`trouble`](Self::trouble) is that none of them arrive. Other bytes may arrive meanwhile.
    fn missing(&self) -> Option<&'static str>;

    /// The rate at which it listens, and talks if it does, in bits per second.
    fn rate(&self) -> u32;

    /// What became of the bytes and of what the scanner must have sent.
    fn account(&self) -> Account;
}

/// Writes those methods of a [`Session`] that say the same of whatever session is inside: `$each!(of, session => said)` says
/// `said` of the one that is in `of`.
#[macro_export]
macro_rules! delegate_session {
    ($each:ident) => {
        fn spare(&mut self) -> &mut [u8] {
            $each!(self, session => session.spare())
        }

        fn commit(&mut self, now: schema::Nanos, len: usize) {
            $each!(self, session => session.commit(now, len))
        }

        fn may_leave(&self) -> bool {
            $each!(self, session => session.may_leave())
        }

        fn leave(&mut self, now: schema::Nanos, waiting: usize) -> bool {
            $each!(self, session => session.leave(now, waiting))
        }

        fn handle_timeout(&mut self, now: schema::Nanos) {
            $each!(self, session => session.handle_timeout(now))
        }

        fn control(&mut self, control: $crate::line::Control, now: schema::Nanos) {
            $each!(self, session => session.control(control, now))
        }

        fn followed(&mut self, now: schema::Nanos, is_followed: bool) {
            $each!(self, session => session.followed(now, is_followed))
        }

        fn end(&mut self, now: schema::Nanos) -> bool {
            $each!(self, session => session.end(now))
        }

        fn transmitted(&mut self, now: schema::Nanos) {
            $each!(self, session => session.transmitted(now))
        }

        fn state(&self) -> $crate::line::State {
            $each!(self, session => session.state())
        }

        fn missing(&self) -> Option<&'static str> {
            $each!(self, session => session.missing())
        }

        fn rate(&self) -> u32 {
            $each!(self, session => session.rate())
        }

        fn account(&self) -> $crate::line::Account {
            $each!(self, session => session.account())
        }
    };
}

/// What a session wants, in the order in which it wants it.
#[derive(Debug)]
pub enum Output<H> {
    /// Set the port to this rate, in bits per second, and forget what it had received, then go on draining.
    SetRate(u32),
    /// Assert the line DTR of a serial port, or clear it; other ports have none. Then go on draining.
    SetDtr(bool),
    /// Write this byte, not before the time given, then say so by [`Session::transmitted`]. Do nothing else meanwhile:
    /// a request may have to come without pauses.
    Transmit {
        /// The byte.
        byte: u8,
        /// Earliest time to write it.
        not_before: Nanos,
    },
    /// Something arrived.
    Heard(H),
    /// Leave the port alone until then: nothing can be complete before, or it can wait so long.
    Rest(Nanos),
    /// Read when the port has bytes; at the deadline, if a read finds none, call [`Session::handle_timeout`].
    Wait {
        /// The deadline; [`Nanos::MAX`] is none.
        until: Nanos,
    },
}

impl<H> Output<H> {
    /// Returns the same output, with `f` applied to what arrived.
    pub fn map<T>(self, f: impl FnOnce(H) -> T) -> Output<T> {
        match self {
            Output::SetRate(rate) => Output::SetRate(rate),
            Output::SetDtr(on) => Output::SetDtr(on),
            Output::Transmit { byte, not_before } => Output::Transmit { byte, not_before },
            Output::Heard(heard) => Output::Heard(f(heard)),
            Output::Rest(until) => Output::Rest(until),
            Output::Wait { until } => Output::Wait { until },
        }
    }
}

/// Bytes of a scanner as they arrived, with their stamps, and the `message` that its family reads in them.
#[derive(Clone, Copy, Debug)]
pub struct Received<'a, M> {
    /// The bytes, in the session's buffer.
    pub bytes: &'a [u8],
    /// What they say.
    pub message: M,
    /// When the first one arrived.
    pub first: Nanos,
    /// When the last one arrived.
    pub last: Nanos,
    /// Whether `first` is an estimate from bytes that came in one read.
    pub estimated: bool,
    /// Why they are suspect, bits of [`crate::line::suspect`]; 0 is clean.
    pub reasons: u8,
}

/// How far a session is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// Listening for a stream, or looking for the rate.
    Probing,
    /// Changing the rate.
    Switching,
    /// Changing settings and starting the stream, or learning what it is.
    Starting,
    /// Measured data come.
    Streaming,
    /// They stopped coming.
    Silent,
    /// Nothing is wanted of the scanner.
    Paused,
}

/// What a user may ask of a running session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Control {
    /// Stop the stream, then say nothing and expect nothing.
    Pause,
    /// End the pause: begin as a new session does.
    Resume,
    /// Restart the session, whatever the state is; ends a pause too.
    Resync,
}

/// The counts that every session keeps; every one but `buffered` only grows. Always
/// `read == in_telegrams + acknowledge + discarded + buffered`, in bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Account {
    /// Bytes read.
    pub read: u64,
    /// Bytes of what was handed out.
    pub in_telegrams: u64,
    /// Bytes of single acknowledgements.
    pub acknowledge: u64,
    /// Bytes that were in nothing.
    pub discarded: u64,
    /// Bytes whose fate is open.
    pub buffered: u64,
    /// Intact transmissions of the scanner.
    pub telegrams: u64,
    /// Transmissions that a streaming scanner must have sent since the first one of each stream.
    pub due: u64,
    /// Those of them that did not arrive.
    pub lost: u64,
    /// Bytes of streams that were in nothing.
    pub damaged: u64,
    /// What looked like a transmission and had a wrong checksum.
    pub rejected_checksum: u64,
    /// How often the session began again.
    pub resyncs: u64,
    /// Restarts of the scanner that the session did not request. First contact is not one.
    pub restarts: u64,
    /// Whether the first transmission came after a piece of one: what was in flight when the port was opened.
    pub began_with_a_cut: bool,
}
