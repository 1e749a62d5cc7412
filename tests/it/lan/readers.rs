//! Readers of datagrams in other languages. The tests compare them with the reader in `schema`, for golden datagrams
//! and for damaged datagrams with a right checksum.

use std::io::{BufRead, BufReader, Write};
use std::process::{ChildStdin, ChildStdout, Command, Stdio};

use scanhub_schema::datagram::{Datagram, DatagramPayload};
use scanhub_schema::{Counter, Scan};
use serde_json::{Map, Value, json};

use crate::testkit::{Child, spawn};

use super::{damaged, keyed_vectors, vectors};

/// Program that reads a datagram in hexadecimal digits from stdin and replies with a line of JSON.
pub(crate) struct Reader {
    child: Child,
    input: ChildStdin,
    output: BufReader<ChildStdout>,
}

impl Reader {
    pub(crate) fn start(command: &mut Command) -> Reader {
        let mut child = spawn(command.stdin(Stdio::piped()).stdout(Stdio::piped())).expect("a program");
        let (input, output) = (child.stdin.take().expect("a pipe"), child.stdout.take().expect("a pipe"));
        Reader { child, input, output: BufReader::new(output) }
    }

    /// Sends a datagram to the program and returns its reply. `key` is the text that precedes the datagram in the
    /// program's input: the digits of the key, `@` and the second of the arrival.
    pub(crate) fn read(&mut self, key: Option<&str>, datagram: &[u8]) -> Value {
        let digits: String = datagram.iter().map(|byte| format!("{byte:02x}")).collect();
        self.request(&key.map_or(digits.clone(), |key| format!("{key}:{digits}")))
    }

    fn request(&mut self, line: &str) -> Value {
        writeln!(self.input, "{line}").expect("the reader reads its stdin");
        let mut answer = String::new();
        self.output.read_line(&mut answer).expect("the reader prints a line");
        serde_json::from_str(&answer).unwrap_or_else(|error| panic!("{error} in {answer:?} to {line}"))
    }

    /// Closes stdin, and asserts that the program exits successfully.
    pub(crate) fn end(mut self) {
        drop(self.input);
        assert!(self.child.wait().expect("the reader exits").success());
    }
}

/// Asserts that the reader's result for each golden datagram equals the result in the list. If the result in the list
/// depends on earlier datagrams or on a key, the reader's result must instead equal that of `schema` for this datagram
/// alone.
pub(crate) fn check_vectors(reader: &mut Reader) {
    for vector in vectors::vectors() {
        let says = vector.description.as_object().expect("an object");
        let by_itself =
            !["after", "after_hubs", "from_another", "with_key"].iter().any(|key| says.contains_key(*key));
        let expected = if by_itself { vector.description.clone() } else { damaged::expected(&vector.bytes) };
        assert_same(&vector.name, &vector.bytes, reader.read(None, &vector.bytes), &expected);
    }
}

/// Asserts that the reader, if it has the key, accepts and refuses the same datagrams as the receiver in Rust. The list
/// contains repeated datagrams, too.
pub(crate) fn check_keyed_vectors(reader: &mut Reader) {
    let keyed = keyed_vectors::read_vectors();
    for step in keyed.steps {
        let digits: String = step.bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        let reported = reader.request(&format!("{}@{}:{digits}", keyed.key, step.at_s));
        assert_eq!(reported["outcome"], step.outcome, "{}", step.name);
    }
}

/// Asserts that the reader and `schema` agree on the validity and the content of `count` damaged datagrams.
pub(crate) fn check_damaged(reader: &mut Reader, count: u32) {
    for (datagram, expected) in damaged::datagrams(count) {
        assert_same("a damaged one", &datagram, reader.read(None, &datagram), &expected);
    }
}

fn assert_same(name: &str, bytes: &[u8], mut reported: Value, expected: &Value) {
    if let Some(metres) = reported["payload"].as_object_mut().and_then(|payload| payload.remove("m")) {
        let mut scan = Scan::zeroed(bytes.len());
        assert!(scan.unpack(Datagram::read(bytes).expect("the datagram is valid").payload));
        let expected: Vec<_> = (0..scan.beams()).map(|i| scan.distance_m(i)).collect();
        assert_eq!(metres, as_read_from_json(&json!(expected)), "{name}: {bytes:02x?}");
    }
    // If the reader reports the counters as a list without names, add the names.
    if let Some(counters) = reported["payload"]["counters"].as_array() {
        let names = Counter::ALL.iter().map(|counter| counter.name().to_owned());
        let named: Map<String, Value> = names.zip(counters.iter().cloned()).collect();
        reported["payload"]["counters"] = named.into();
    }
    for key in ["head", "payload", "refusal"] {
        assert_eq!(reported[key], as_read_from_json(&expected[key]), "{key} of {name}: {bytes:02x?}");
    }
}

/// Converts a value to text and back, so that it has the same rounding as a value from a reader: parsing may change the
/// last bit of a number with many digits.
fn as_read_from_json(value: &Value) -> Value {
    serde_json::from_str(&value.to_string()).expect("JSON")
}
