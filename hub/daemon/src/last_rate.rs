//! At which rate the sensor of a link was found the last time that it had to be sought, for the next start: a sensor that
//! gets its power is at the same rate each time, and whoever asks there first saves the time of an answer that does not
//! come. A line of text in the domain's state. Refuses to know how a sensor is sought; a wrong rate costs that time, and
//! nothing else.

use std::thread;

use lms::Session;
use lms::variant::Baud;
use schema::{Failure, StateDirectory};

/// That of one link.
pub(crate) struct LastRate {
    /// Where it is kept; nowhere if the environment names no place, or nothing is to be kept.
    state: Option<StateDirectory>,
    /// Of which link, and of which port it is.
    link: String,
    port: String,
    known: Option<Baud>,
}

impl LastRate {
    /// What `state` says of `link` at `port`.
    pub(crate) fn open(state: Option<&StateDirectory>, link: &str, port: &str) -> LastRate {
        let mut last =
            LastRate { state: state.cloned(), link: link.to_owned(), port: port.to_owned(), known: None };
        let text = state.map_or(Ok(None), |state| state.read(&last.file(), LONGEST));
        match text {
            Ok(text) => last.known = text.and_then(|text| last.parse(&text)),
            Err(failure) => last.complain(&failure),
        }
        last
    }

    /// Where a sensor was found the last time; nothing if that is not known of this port.
    pub(crate) fn baud(&self) -> Option<Baud> {
        self.known
    }

    /// Keeps where `session` found its sensor, if that is news. The disk is waited for by a thread of its own.
    pub(crate) fn keep(&mut self, session: &Session) {
        if let Some(found) = session.found_at().filter(|&found| self.known != Some(found)) {
            self.known = Some(found);
            if let Some(written) = self.write(found) {
                // Without a thread it is not kept, and sought again.
                let _ = thread::Builder::new().name(self.file()).spawn(written);
            }
        }
    }

    fn write(&self, found: Baud) -> Option<impl FnOnce() + Send + 'static> {
        let (state, file, link) = (self.state.clone()?, self.file(), self.link.clone());
        let text = format!("{} {}\n", found.rate(), self.port);
        Some(move || {
            if let Err(failure) = state.write(&file, &text) {
                tracing::warn!("{link}: {}; {}", failure.message, failure.hint);
            }
        })
    }

    fn parse(&self, text: &str) -> Option<Baud> {
        let (rate, port) = text.strip_suffix('\n')?.split_once(' ')?;
        let rate: u32 = rate.parse().ok()?;
        Baud::ALL.into_iter().find(|baud| baud.rate() == rate && port == self.port)
    }

    fn complain(&self, failure: &Failure) {
        tracing::warn!("{}: {}; {}", self.link, failure.message, failure.hint);
    }

    fn file(&self) -> String {
        format!("{}.rate", self.link)
    }
}

/// Bytes of such a file: a rate, and a port, which has a path's length at the most.
const LONGEST: u64 = 8_192;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn where_it_was_found_is_known_of_this_link_at_this_port() {
        let root = std::env::temp_dir().join(format!("scanhub-last-rate-{}", std::process::id()));
        let state = StateDirectory::at(root.join("state"));
        let port = "/dev/serial/by-id/usb-FTDI 1";
        let open = |link, port| LastRate::open(Some(&state), link, port).baud();
        assert_eq!(open("front", port), None, "the first one");
        for found in Baud::ALL {
            let last = LastRate::open(Some(&state), "front", port);
            last.write(found).expect("a place")();
            assert_eq!(open("front", port), Some(found));
            assert_eq!((open("rear", port), open("front", "/dev/ttyUSB0")), (None, None));
        }
        for torn in ["", "9600", "9600\n", "9601 /dev/x\n", "9600 /dev/x", " /dev/x\n", "\n\n"] {
            state.write("front.rate", torn).unwrap();
            assert_eq!(open("front", "/dev/x"), None, "{torn:?}");
        }
        // What cannot be believed is as good as nothing.
        state.write("front.rate", &"9".repeat(10_000)).unwrap();
        assert_eq!(open("front", port), None);
        let nowhere = LastRate::open(None, "front", port);
        assert!(nowhere.baud().is_none() && nowhere.write(Baud::B9600).is_none());
        std::fs::remove_dir_all(&root).unwrap();
    }
}
