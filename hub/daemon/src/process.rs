//! Services that the hub needs from the operating system: its signals, its memory and descriptors, and eventfds that
//! wake a thread.
//!
//! If /dev/shm is full, the kernel kills the hub by SIGBUS when the hub first touches a page of a sparse segment. The
//! hub therefore checks memory and descriptors before it starts a link. If another process takes the memory at the same
//! moment, [`explain_bus_error`] prints a last message.

use std::io::Read;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::net::UnixStream;

use rustix::event::{EventfdFlags, eventfd};
use rustix::fs::{Mode, OFlags, open};
use rustix::stdio::{stderr, stdout};
use scanhub_config::resource_estimate;
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Kind};
use scanhub_shm::resource_limits;
use signal_hook::consts::{SIGBUS, SIGHUP, SIGINT, SIGTERM};
use signal_hook::low_level;
use signal_hook::low_level::pipe::register;

/// Signals that this process has received. SIGINT and SIGTERM end the hub. SIGHUP reloads the configuration, or ends
/// the hub if its terminal was closed.
pub(crate) struct Signals {
    /// Stream that is readable after SIGINT and SIGTERM.
    end: UnixStream,
    /// Stream that is readable after SIGHUP.
    hangup: UnixStream,
    /// Whether SIGHUP ends the hub, because its terminal was closed.
    ends_with_terminal: bool,
}

/// Action that a signal requests.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SignalAction {
    End,
    Reload,
}

impl Signals {
    /// Installs the handlers.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`] if no descriptors are left.
    pub(crate) fn register() -> Result<Signals, Failure> {
        // Under `nohup`, SIGHUP is ignored.
        let ends_with_terminal = has_terminal() && !is_hangup_ignored();
        let registered = || {
            let ((end, end_sender), (hangup, hangup_sender)) = (UnixStream::pair()?, UnixStream::pair()?);
            [&end, &hangup].into_iter().try_for_each(|stream| stream.set_nonblocking(true))?;
            register(SIGINT, end_sender.try_clone()?)?;
            register(SIGTERM, end_sender)?;
            register(SIGHUP, hangup_sender)?;
            Ok(Signals { end, hangup, ends_with_terminal })
        };
        registered().map_err(|error: std::io::Error| no_resource("a signal handler", &error))
    }

    /// Returns descriptors that become readable when a signal arrives.
    pub(crate) fn descriptors(&self) -> [BorrowedFd<'_>; 2] {
        [self.end.as_fd(), self.hangup.as_fd()]
    }

    /// Returns the action that the signals since the last call request.
    pub(crate) fn take(&self) -> Option<SignalAction> {
        let has_arrived = |mut stream: &UnixStream| stream.read(&mut [0; 64]).is_ok_and(|count| count > 0);
        if has_arrived(&self.end) {
            return Some(SignalAction::End);
        }
        let lost_terminal = || self.ends_with_terminal && !has_terminal();
        has_arrived(&self.hangup)
            .then(|| if lost_terminal() { SignalAction::End } else { SignalAction::Reload })
    }
}

/// An eventfd that wakes a thread in `poll`. It stays readable until it is cleared.
pub(crate) struct EventFd(OwnedFd);

impl EventFd {
    /// Creates an eventfd that is not readable.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`] if no descriptors are left.
    pub(crate) fn new() -> Result<EventFd, Failure> {
        let created = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK);
        created.map(EventFd).map_err(|error| {
            Failure::new(
                Kind::ResourceExhausted,
                format!("cannot get an eventfd: {error}"),
                "raise `ulimit -n`",
            )
        })
    }

    pub(crate) fn signal(&self) {
        // The write fails only if the counter would overflow, and the eventfd is then already readable.
        let _ = rustix::io::write(&self.0, &1_u64.to_ne_bytes());
    }

    pub(crate) fn clear(&self) {
        // The read fails only if the eventfd is not readable.
        let _ = rustix::io::read(&self.0, &mut [0; 8]);
    }
}

impl AsFd for EventFd {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}

/// Makes SIGBUS end the process with the exit code of [`Kind::ResourceExhausted`], after one message: text to stderr,
/// or with `json` an object of class `error` to stdout. If stdout `is_taken`, the object goes to stderr.
#[allow(unsafe_code)]
pub fn explain_bus_error(json: bool, is_taken: bool) {
    let (message, output): (&[u8], fn() -> BorrowedFd<'static>) = match (json, is_taken) {
        (false, _) => (BUS_ERROR_TEXT, stderr),
        (true, false) => (BUS_ERROR_JSON, stdout),
        (true, true) => (BUS_ERROR_JSON, stderr),
    };
    let handler = move || {
        let _ = rustix::io::write(output(), message);
        low_level::exit(i32::from(Kind::ResourceExhausted.exit_code()));
    };
    // SAFETY: the handler only calls write(2) and _exit(2), both async-signal-safe.
    if let Err(error) = unsafe { low_level::register(SIGBUS, handler) } {
        tracing::warn!(%error, "if /dev/shm is full, this process will end without a message");
    }
}

/// Raises the limit of open descriptors to the hard limit of the process.
pub(crate) fn raise_descriptor_limit() {
    if let Err(error) = resource_limits::raise_descriptor_limit() {
        tracing::warn!(%error, "cannot raise the limit of open descriptors: fewer subscribers can attach");
    }
}

/// Checks that /dev/shm has room for the topics of the links, one for each of the `limits`, and for a first subscriber
/// of each link. Also checks that the address space of the process has room for this memory and for the threads of the
/// links.
///
/// # Errors
///
/// Returns [`Kind::ResourceExhausted`] with the free and the needed size.
pub(crate) fn check_memory(limits: &[TopicLimits]) -> Result<(), Failure> {
    let needed = resource_estimate::memory(limits);
    resource_limits::check_address_space(needed + limits.len() as u64 * THREAD_ADDRESS_SPACE)?;
    resource_limits::check_memory(needed, resource_estimate::longest_segment(limits))
}

/// Checks that `links` links, and a first subscriber of each, have enough descriptors.
///
/// # Errors
///
/// Returns [`Kind::ResourceExhausted`] with the limit and the needed number.
pub(crate) fn check_descriptors(links: usize) -> Result<(), Failure> {
    resource_limits::check_descriptors(resource_estimate::descriptors(links))
}

/// Returns the failure that `resource` is not available now.
pub(crate) fn no_resource(resource: &str, error: &dyn std::fmt::Display) -> Failure {
    Failure::new(Kind::ResourceExhausted, format!("cannot get {resource}: {error}"), "try again later")
}

/// Returns whether the process has an open terminal. If it has, the kernel sends SIGHUP when the terminal is closed.
fn has_terminal() -> bool {
    open("/dev/tty", OFlags::RDONLY | OFlags::NOCTTY | OFlags::CLOEXEC, Mode::empty()).is_ok()
}

/// Returns whether this process ignores SIGHUP, as under `nohup`.
pub fn is_hangup_ignored() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    ignored.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).is_some_and(|mask| mask & 1 != 0)
}

const BUS_ERROR_TEXT: &[u8] =
    b"scanhub: shared memory is full (bus error)\n  free some of /dev/shm, then start again\n";
const BUS_ERROR_JSON: &[u8] =
    b"{\"class\":\"error\",\"kind\":\"short\",\"message\":\"shared memory is full (bus error)\",\
\"hint\":\"free some of /dev/shm, then start again\"}\n";
/// Address space of a link's thread in bytes: its stack, its heap, and other mappings besides its segments.
const THREAD_ADDRESS_SPACE: u64 = 4 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_that_need_too_much_memory_are_refused() {
        assert!(check_memory(&[TopicLimits::default(); 2]).is_ok());
        let huge = TopicLimits { telegram: 1 << 50, ..TopicLimits::default() };
        let failure = check_memory(&[huge]).unwrap_err();
        assert_eq!(failure.kind, Kind::ResourceExhausted);
        assert!(failure.message.contains("kB needed"), "{failure}");
    }
}
