//! Log of the telegrams that the simulator has sent: one line per telegram, and one per port at the end, in a file or on
//! stdout. The hub never reads it.

use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use scanhub_files::output::{self, Target};
use schema::{Failure, Kind};
use serde_json::json;
use sha2::{Digest, Sha256};

use crate::fault::Fault;

/// A telegram that the sensor sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Record {
    /// The port as it was named.
    pub port: PathBuf,
    /// Number of the telegram on this port, data and replies together, from 0.
    pub index: u64,
    /// Whether it is a reply, and not data of the stream.
    pub is_reply: bool,
    /// Bytes of the intact telegram.
    pub length: usize,
    /// SHA-256 of the intact telegram.
    pub sha256: [u8; 32],
    /// CLOCK_MONOTONIC after its last byte was written, in nanoseconds.
    pub sent_ns: u64,
    /// Why it did not arrive as it should have, if so.
    pub fault: Option<Fault>,
}

impl Record {
    /// SHA-256 of `telegram`.
    pub fn hash(telegram: &[u8]) -> [u8; 32] {
        Sha256::digest(telegram).into()
    }

    /// Its line, without the end; the keys in the order of the contract.
    pub fn line(&self) -> String {
        let port = json!(self.port.to_string_lossy());
        let kind = if self.is_reply { "reply" } else { "data" };
        let sha256 = self.sha256.map(|byte| format!("{byte:02x}")).concat();
        let fault = json!(self.fault.map(Fault::name));
        let Record { index, length, sent_ns, .. } = self;
        format!(
            r#"{{"class":"truth","port":{port},"index":{index},"kind":"{kind}","length":{length},"sha256":"{sha256}","sent_ns":{sent_ns},"fault":{fault}}}"#
        )
    }
}

/// What a port sent in all.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Summary {
    /// The port as it was named.
    pub port: PathBuf,
    /// Telegrams sent: the number of its records, those with a fault too.
    pub sent: u64,
    /// Requests heard that would have written the sensor's EEPROM.
    pub eeprom_writes: u64,
}

impl Summary {
    /// Its line, without the end.
    pub fn line(&self) -> String {
        let port = json!(self.port.to_string_lossy());
        let Summary { sent, eeprom_writes, .. } = self;
        format!(r#"{{"class":"simulated","port":{port},"sent":{sent},"eeprom_writes":{eeprom_writes}}}"#)
    }
}

/// Lines that several ports write, one write per line.
#[derive(Debug)]
pub struct Truth {
    path: PathBuf,
    /// `None` for stdout.
    file: Option<Mutex<File>>,
}

impl Truth {
    /// Creates the file at `path`, which replaces an existing one if `force`. `-` is stdout.
    ///
    /// # Errors
    ///
    /// Those of [`Target::create_new`].
    pub fn create(path: &Path, force: bool) -> Result<Self, Failure> {
        let is_stdout = path == Path::new("-");
        let file =
            if is_stdout { None } else { Some(Target::open(path)?.create_new(force, output::PUBLIC)?) };
        Ok(Truth { path: path.to_owned(), file: file.map(Mutex::new) })
    }

    /// Appends `line`.
    ///
    /// # Errors
    ///
    /// [`Kind::Failed`] if it cannot be written.
    pub fn write(&self, line: &str) -> Result<(), Failure> {
        let line = format!("{line}\n");
        let written = match &self.file {
            // A thread that panicked with the lock wrote its line or not: either way the next one begins a new line.
            Some(file) => {
                file.lock().unwrap_or_else(std::sync::PoisonError::into_inner).write_all(line.as_bytes())
            }
            None => {
                let mut stdout = io::stdout().lock();
                stdout.write_all(line.as_bytes()).and_then(|()| stdout.flush())
            }
        };
        written.map_err(|error| failure(&self.path, &error))
    }
}

fn failure(path: &Path, error: &io::Error) -> Failure {
    let what = format!("cannot write the truth to {}: {error}", path.display());
    Failure::new(Kind::Failed, what, "the disk must have space, and the reader of stdout must stay")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_as_the_contract_says() {
        let record = Record {
            port: "/tmp/a".into(),
            index: 3,
            is_reply: false,
            length: 3,
            sha256: Record::hash(b"abc"),
            sent_ns: 12_345_678_901_234,
            fault: None,
        };
        let value: serde_json::Value = serde_json::from_str(&record.line()).unwrap();
        assert_eq!(
            value,
            json!({
                "class": "truth", "port": "/tmp/a", "index": 3, "kind": "data", "length": 3,
                "sha256": "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad",
                "sent_ns": 12_345_678_901_234u64, "fault": null,
            })
        );
        let reply = Record { is_reply: true, fault: Some(Fault::Unread), ..record }.line();
        assert!(reply.contains(r#""kind":"reply""#) && reply.contains(r#""fault":"unread""#));
        let summary = Summary { port: "/tmp/a".into(), sent: 7, eeprom_writes: 0 }.line();
        assert!(summary.contains(r#""class":"simulated""#) && summary.contains(r#""sent":7"#));
    }
}
