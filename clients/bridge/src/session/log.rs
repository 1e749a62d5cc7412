//! Collects Zenoh's log lines about failed connections. Only these lines contain the reason of a failure. The newest
//! lines wait until they are reported. A repeated line is reported only once. All other log lines of Zenoh are ignored.

use std::collections::VecDeque;
use std::fmt::{Debug, Write};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Level, Metadata, Subscriber};

/// Log lines of this process.
#[derive(Clone, Default)]
pub(super) struct Log(Arc<Mutex<Lines>>);

#[derive(Default)]
struct Lines {
    waiting: VecDeque<String>,
    /// Lines that were reported or still wait. A line that is in this list is not reported again.
    recent: VecDeque<String>,
    count: u64,
}

/// Maximum number of waiting lines, and maximum number of recent lines. Any program that can connect can cause lines,
/// so both lists are limited.
const MAX_LINES: usize = 16;
/// Maximum length of a line in bytes.
const MAX_LINE_LEN: usize = 500;

/// Texts at which a line is cut, and the number of bytes of the text that are kept. The rest of the line differs in
/// each attempt (time until the next attempt, local port), or is advice for another system.
const CUT_MARKERS: [(&str, usize); 3] =
    [(" Retry in ", 0), ("Syn on: ", 3), (" Hint: increase the system", 0)];
/// Suffix that Zenoh adds to addresses because of the settings in `config.rs`.
const OUR_LIMIT: &str = "#so_sndbuf=8192";

/// Messages that Zenoh logs only at debug level: source, and start of the text. These messages contain the reason why a
/// lost connection cannot be restored, or why an incoming connection was refused.
const QUIET_MESSAGES: [(&str, &str); 3] = [
    ("zenoh::net::runtime::orchestrator", "Unable to connect"),
    ("zenoh_link_tls::unicast", "Can not accept"),
    ("zenoh_transport::unicast::establishment::accept", ""),
];
/// Start of Zenoh's line about a link that Zenoh closes because the link has no room. This line does not count as a
/// refused connection.
const CLOSED_MESSAGE: &str = "Unable to push";
/// Start of a message about a connection that was accepted.
const ACCEPTED_MESSAGE: &str = "New transport";

impl Log {
    /// Collects log lines from now on. If the process already has another subscriber for logs, nothing is collected.
    pub(super) fn install() -> Log {
        let log = Log::default();
        let _ = tracing::subscriber::set_global_default(LogSubscriber(log.clone()));
        log
    }

    /// Returns the lines that were not reported yet, and marks them as reported.
    pub(super) fn take(&self) -> Vec<String> {
        self.lines().waiting.drain(..).collect()
    }

    /// Returns the number of lines about failed and refused connections so far, including repeated lines.
    pub(super) fn count(&self) -> u64 {
        self.lines().count
    }

    fn lines(&self) -> MutexGuard<'_, Lines> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn add(&self, line: &str) {
        let end = CUT_MARKERS.iter().filter_map(|(sign, len)| Some(line.find(sign)? + len)).min();
        let mut line = without_locations(&line[..end.unwrap_or(line.len())]).replace(OUR_LIMIT, "");
        let end = line.char_indices().map(|(at, _)| at).find(|at| *at + 4 > MAX_LINE_LEN);
        line.truncate(end.unwrap_or(line.len()));
        let mut lines = self.lines();
        lines.count += u64::from(!line.starts_with(CLOSED_MESSAGE));
        if lines.recent.contains(&line) {
            return;
        }
        if lines.recent.len() == MAX_LINES {
            lines.recent.pop_front();
        }
        if lines.waiting.len() == MAX_LINES {
            lines.waiting.pop_front();
        }
        lines.recent.push_back(line.clone());
        lines.waiting.push_back(line);
    }
}

/// Returns `line` without the source locations in Zenoh's errors, ` at PATH.rs:LINE`.
pub(super) fn without_locations(line: &str) -> String {
    let mut kept = String::with_capacity(line.len());
    let mut remainder = line;
    while let Some(at) = remainder.find(" at ") {
        let (before, after) = remainder.split_at(at);
        let word = after[4..].split([' ', ']', ')']).next().unwrap_or_default();
        kept.push_str(before);
        if !word.contains(".rs:") {
            kept.push_str(" at ");
            remainder = &after[4..];
            continue;
        }
        remainder = &after[4 + word.len()..];
    }
    kept.push_str(remainder);
    kept
}

struct LogSubscriber(Log);

impl Subscriber for LogSubscriber {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        let is_zenoh = metadata.target().starts_with("zenoh");
        let is_quiet = QUIET_MESSAGES.iter().any(|(target, _)| metadata.target() == *target);
        let level = *metadata.level();
        metadata.is_event() && is_zenoh && (level <= Level::WARN || is_quiet && level == Level::DEBUG)
    }

    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}

    fn record_follows_from(&self, _: &Id, _: &Id) {}

    fn event(&self, event: &Event<'_>) {
        let mut message = MessageText(String::new());
        event.record(&mut message);
        let is_relevant = |(target, begin): &(&str, &str)| {
            event.metadata().target() == *target
                && message.0.starts_with(begin)
                && !message.0.starts_with(ACCEPTED_MESSAGE)
        };
        if *event.metadata().level() <= Level::WARN || QUIET_MESSAGES.iter().any(is_relevant) {
            self.0.add(&message.0);
        }
    }

    fn enter(&self, _: &Id) {}

    fn exit(&self, _: &Id) {}
}

/// Text of an event.
struct MessageText(String);

impl Visit for MessageText {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        if field.name() == "message" {
            let _ = write!(self.0, "{value:?}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn source_locations_are_removed_from_zenoh_errors() {
        let line =
            "no link: [host: refused (error 111) at /a/b-1.0/tcp.rs:105.] at /a/c.rs:1. at noon. Retry";
        assert_eq!(without_locations(line), "no link: [host: refused (error 111)] at noon. Retry");
    }

    #[test]
    fn repeated_lines_are_merged_and_a_flood_is_bounded() {
        let log = Log::default();
        log.add("no route");
        log.add("no route");
        assert_eq!((log.take(), log.take(), log.count()), (vec!["no route".to_owned()], vec![], 2));
        log.add("Too many open files (os error 24). Hint: increase the system open file limit.");
        assert_eq!(log.take(), ["Too many open files (os error 24)."]);
        let refused = log.count();
        log.add("Unable to push non droppable network message to 1a2b. Closing transport!");
        assert_eq!((log.take().len(), log.count()), (1, refused), "a closed link was not refused");
        log.add("no tcp/r:1#so_sndbuf=8192: refused. Retry in 100ms.");
        log.add("no tcp/r:1#so_sndbuf=8192: refused. Retry in 200ms.");
        assert_eq!(log.take(), ["no tcp/r:1: refused."]);
        log.add(
            "a close message in response to an OpenSyn on: TransportLinkUnicast { src: tcp/127.0.0.1:7 }",
        );
        log.add(
            "a close message in response to an OpenSyn on: TransportLinkUnicast { src: tcp/127.0.0.1:8 }",
        );
        assert_eq!(log.take(), ["a close message in response to an OpenSyn"]);
        (0..1000).for_each(|n| log.add(&format!("{n} {}", "é".repeat(1000))));
        let lines = log.take();
        assert!(lines.len() == MAX_LINES && lines.iter().all(|line| line.len() <= MAX_LINE_LEN), "{lines:?}");
        assert!(lines.last().is_some_and(|line| line.starts_with("999 ")));
    }
}
