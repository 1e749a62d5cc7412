//! Minimal service manager for hubs with one link. It receives the notifications of the hub, stores the descriptor of
//! the line, and passes it to the next hub as descriptor 3.

use std::io::IoSliceMut;
use std::mem::MaybeUninit;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixDatagram;
use std::process::{Command, Stdio};
use std::time::Duration;

use rustix::io::Errno;
use rustix::net::{RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, recvmsg};

use super::WAIT_TIMEOUT;

/// Service manager with its notification socket.
pub(crate) struct Supervisor {
    socket: UnixDatagram,
    path: String,
    /// Descriptor that a hub has stored, with its name.
    stored_descriptor: Option<(String, OwnedFd)>,
    /// Lines of all notifications from all hubs.
    pub(crate) messages: Vec<String>,
    /// Lines from the last hub for which the test has not waited yet. They have no fixed order, because each thread of
    /// the hub sends its own notifications.
    unread_messages: Vec<String>,
}

impl Supervisor {
    /// Creates a service manager with its socket at `path`.
    pub(crate) fn new(path: String) -> Supervisor {
        let socket = UnixDatagram::bind(&path).unwrap_or_else(|error| panic!("{path}: {error}"));
        Supervisor {
            socket,
            path,
            stored_descriptor: None,
            messages: Vec::new(),
            unread_messages: Vec::new(),
        }
    }

    /// Returns a command that starts `hub` as a service, and the stdin for this command. The stdin is the stored
    /// descriptor, if any. `watchdog` is the watchdog interval.
    pub(crate) fn service(&mut self, hub: &Command, watchdog: Option<Duration>) -> (Command, Stdio) {
        // Discard messages that the previous hub sent at its end, so that they do not count as messages of the new hub.
        self.socket.set_nonblocking(true).expect("a socket");
        while self.receive().is_ok() {}
        self.socket.set_nonblocking(false).expect("a socket");
        self.unread_messages.clear();
        // The environment of a service contains its own process ID. Only a shell can set this variable before it
        // replaces itself with the program.
        let mut command = Command::new("/bin/sh");
        command.args([
            "-c",
            "export LISTEN_PID=$$ WATCHDOG_PID=$$; exec 3<&0 0</dev/null; exec \"$@\"",
            "sh",
        ]);
        command.arg(hub.get_program()).args(hub.get_args());
        command.envs(hub.get_envs().filter_map(|(key, value)| Some((key, value?))));
        command.env("NOTIFY_SOCKET", &self.path);
        if let Some(every) = watchdog {
            command.env("WATCHDOG_USEC", every.as_micros().to_string());
        }
        let Some((name, line)) = &self.stored_descriptor else { return (command, Stdio::null()) };
        command.env("LISTEN_FDS", "1").env("LISTEN_FDNAMES", name);
        let line =
            line.try_clone().unwrap_or_else(|error| panic!("cannot duplicate the descriptor: {error}"));
        (command, line.into())
    }

    /// Waits until the hub has sent the line `message`, and removes this line from the unread ones.
    pub(crate) fn wait_for_message(&mut self, message: &str) {
        self.socket.set_read_timeout(Some(WAIT_TIMEOUT)).expect("a socket");
        while !self.unread_messages.iter().any(|line| line == message) {
            if let Err(error) = self.receive() {
                panic!("the hub did not send {message}: {error}; received {:?}", self.messages);
            }
        }
        let at = self
            .unread_messages
            .iter()
            .position(|line| line == message)
            .expect("the loop ends when the message has arrived");
        self.unread_messages.remove(at);
    }

    fn receive(&mut self) -> Result<(), Errno> {
        let mut text = [0; 1024];
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
        let mut control = RecvAncillaryBuffer::new(&mut space);
        let parts = &mut [IoSliceMut::new(&mut text)];
        let message = recvmsg(&self.socket, parts, &mut control, RecvFlags::CMSG_CLOEXEC)?;
        let lines = String::from_utf8_lossy(&text[..message.bytes]).into_owned();
        let name = lines.lines().find_map(|line| line.strip_prefix("FDNAME=")).unwrap_or_default();
        for passed in control.drain() {
            if let RecvAncillaryMessage::ScmRights(lines) = passed {
                self.stored_descriptor = lines.last().map(|line| (name.to_owned(), line));
            }
        }
        if lines.lines().any(|line| line == "FDSTOREREMOVE=1") {
            self.stored_descriptor = self.stored_descriptor.take().filter(|(kept, _)| kept != name);
        }
        self.messages.extend(lines.lines().map(str::to_owned));
        self.unread_messages.extend(lines.lines().map(str::to_owned));
        Ok(())
    }
}
