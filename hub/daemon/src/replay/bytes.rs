//! Plays a stream of bytes without stamps at the pace of its scans. The bytes pass through a session like those of a
//! line. The session also detects the damaged bytes.

use std::io::Read;

use scanhub_drivers::line::{Action, Event, Protocol as _};
use scanhub_drivers::{PortSession, Settings};
use scanhub_schema::{Failure, MILLIS, Nanos, State};

use super::recorded::{Stream, read};
use super::{ReplayLink, ReplayTiming, VALID_UNTIL_NEXT};
use crate::link_output::RecordedMetadata;
use crate::platform::Platform;

/// One pass through a stream.
pub(crate) struct BytesLap<'f> {
    pub(super) stream: &'f Stream,
    bytes: Box<dyn Read + Send>,
    /// Number of bytes that were read.
    pub(super) read_len: u64,
    session: PortSession,
    recorded: RecordedMetadata,
    /// Media times between which telegrams are published.
    start_ns: Nanos,
    end_ns: Option<Nanos>,
    /// Media time of the next telegram.
    media: Nanos,
    is_over: bool,
    /// Duration for which the last published verdict stays valid.
    lifetime: Option<Nanos>,
    state: State,
}

impl<'f> BytesLap<'f> {
    /// Starts a pass of `replay` through `stream`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Input`](scanhub_schema::Kind) if the file cannot be opened.
    pub(super) fn new<S: Platform>(
        replay: &ReplayLink<'_, S, impl ReplayTiming<S>>,
        stream: &'f Stream,
    ) -> Result<Self, Failure> {
        let (start_ns, end_ns) = replay.timing.range();
        let link = &replay.link;
        let settings = Settings { mode_number: stream.mode, ..link.link.settings() };
        Ok(BytesLap {
            stream,
            bytes: stream.bytes()?,
            read_len: 0,
            session: PortSession::begin(Some(stream.family), &settings, None, link.platform.now()),
            recorded: RecordedMetadata::default(),
            start_ns,
            end_ns,
            media: 0,
            is_over: false,
            lifetime: None,
            state: if stream.has_telegrams() { State::Streaming } else { State::Probing },
        })
    }

    pub(super) fn next_media(&self) -> Option<Nanos> {
        let is_over = self.is_over || self.end_ns.is_some_and(|end_ns| self.media >= end_ns);
        (!is_over).then_some(self.media)
    }

    pub(super) fn step<S: Platform>(
        &mut self,
        replay: &mut ReplayLink<'_, S, impl ReplayTiming<S>>,
    ) -> Option<()> {
        let BytesLap { stream, bytes, read_len, session, recorded, media, .. } = self;
        let is_skipped = *media < self.start_ns;
        if is_skipped {
            if !replay.continue_skipping() {
                return None;
            }
        } else {
            recorded.stretch = replay.wait_until_due(Some(session), *media, self.state)?.stretch;
        }
        let room = session.read_buffer();
        let chunk_len = room.len().min(CHUNK_LEN);
        let len = read(&mut **bytes, &mut room[..chunk_len]);
        *read_len += len as u64;
        let now = replay.link.platform.now();
        session.commit(now, len);
        if len == 0 {
            // Without further bytes, the session has no reason to hold a telegram back.
            session.handle_timeout(now + HOLD_TIME);
        }
        while let Action::Event(Event::Telegram(received)) = session.poll_action() {
            if !is_skipped {
                recorded.measured_ns = Some(*media);
                self.lifetime = replay.link.publish(&received, recorded, false).or(self.lifetime);
                replay.link.output.extend_verdict(VALID_UNTIL_NEXT);
                replay.timing.note_played(*media);
            } else if let Some(scan) = received.contents.and_then(|whole| whole.scan) {
                replay.link.output.learn(&scan, *media);
            }
            if !received.is_reply {
                *media += stream.period(received.contents.map_or(0, |whole| whole.beams));
            }
        }
        if !is_skipped {
            replay.link.publish_status(Some(session), self.state, &replay.problem);
        }
        self.is_over = len == 0;
        Some(())
    }

    /// Returns how long the last verdict stays valid.
    pub(super) fn end<S: Platform>(
        &self,
        replay: &mut ReplayLink<'_, S, impl ReplayTiming<S>>,
    ) -> Option<Nanos> {
        replay.link.stats.close_session(&self.session);
        self.lifetime
    }
}

/// Maximum number of bytes given to the session at a time: less than a telegram, so that stamps stay accurate.
const CHUNK_LEN: usize = 128;
/// Time without bytes after which a session no longer holds a telegram back.
const HOLD_TIME: Nanos = 100 * MILLIS;
