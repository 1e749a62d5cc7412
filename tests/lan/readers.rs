//! Readers in other languages against the one in `schema`: over the golden datagrams, and over damaged ones whose checksum
//! is right.

use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use fastrand::Rng;
use schema::datagram::{Announce, Datagram, HEAD, Head, MTU_ETHERNET, Packed};
use schema::{Counter, Scan, Topic};
use serde_json::{Map, Value, json};

use super::{says, vectors};

/// A program that answers a datagram in hex with a line of JSON.
pub(crate) struct Reader {
    child: Child,
    input: ChildStdin,
    output: BufReader<ChildStdout>,
}

impl Reader {
    pub(crate) fn start(command: &mut Command) -> Reader {
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("a program");
        let (input, output) = (child.stdin.take().expect("a pipe"), child.stdout.take().expect("a pipe"));
        Reader { child, input, output: BufReader::new(output) }
    }

    /// What it says of a datagram; `key` as hex digits.
    pub(crate) fn read(&mut self, key: Option<&str>, datagram: &[u8]) -> Value {
        let digits: String = datagram.iter().map(|byte| format!("{byte:02x}")).collect();
        let line = key.map_or(digits.clone(), |key| format!("{key}:{digits}"));
        writeln!(self.input, "{line}").expect("it reads");
        let mut answer = String::new();
        self.output.read_line(&mut answer).expect("it answers");
        serde_json::from_str(&answer).unwrap_or_else(|error| panic!("{error} in {answer:?} to {line}"))
    }

    /// It ends by itself, and well.
    pub(crate) fn end(mut self) {
        drop(self.input);
        assert!(self.child.wait().expect("it ends").success());
    }
}

/// Every golden datagram is what the list says. What depends on those before it, or on a key, is sound by itself.
pub(crate) fn golden(reader: &mut Reader) {
    for vector in vectors::vectors() {
        let says = vector.says.as_object().expect("an object");
        let by_itself = !["after", "after_hubs", "with_key"].iter().any(|key| says.contains_key(*key));
        let expected = if by_itself { vector.says.clone() } else { expected(&vector.bytes) };
        same(&vector.file, &vector.bytes, reader.read(None, &vector.bytes), &expected);
    }
}

/// Whatever a payload says, they agree on whether it is sound and on what it says.
pub(crate) fn damaged(reader: &mut Reader, rounds: u32) {
    let mut random = Rng::with_seed(6);
    let golden: Vec<Vec<u8>> = vectors::vectors().into_iter().map(|vector| vector.bytes).collect();
    let (mut sound, mut unsound) = (0, 0);
    for _ in 0..rounds {
        let bytes = &golden[random.usize(..golden.len())];
        let Ok(datagram) = Datagram::read(bytes) else { continue };
        let damaged = damage(&mut random, &datagram);
        let expected = expected(&damaged);
        if expected["refusal"].is_null() {
            sound += 1
        } else {
            unsound += 1
        }
        same("a damaged one", &damaged, reader.read(None, &damaged), &expected);
    }
    assert!(sound > rounds / 10 && unsound > rounds / 10, "{sound} of {rounds} sound, {unsound} not");
}

/// A few bytes of header and payload are others, or the payload ends earlier or later. Text and what is no number stay:
/// languages differ in how they show those.
fn damage(random: &mut Rng, datagram: &Datagram<'_>) -> Vec<u8> {
    let mut payload = datagram.payload.to_vec();
    let spared = match Topic::of_number(datagram.head.topic) {
        Some(Topic::Status) => vec![24..336, 560..592],
        None => vec![8..64],
        Some(_) => Vec::new(),
    };
    for _ in 0..random.usize(..4) {
        // The beginning has the counts.
        let end = if random.bool() { payload.len() } else { payload.len().min(20) };
        let at = random.usize(..end.max(1));
        if at < payload.len() && !spared.iter().any(|range| range.contains(&at)) {
            payload[at] = match random.u8(..4) {
                0 => random.u8(..),
                1 => random.u8(..4),
                2 => payload[at].wrapping_add(1),
                _ => payload[at].wrapping_sub(1),
            };
        }
    }
    match random.u8(..8) {
        0 => payload.truncate(random.usize(..=payload.len())),
        1 => payload.extend(std::iter::repeat_with(|| random.u8(..)).take(20)),
        _ => {}
    }
    let mut head = Head { flags: datagram.head.flags & !1, sequence: random.u32(..), ..datagram.head };
    if random.u8(..20) == 0 {
        head.revision = random.u16(..3);
    }
    if random.u8(..20) == 0 && head.topic != Topic::Status.number() && head.topic != Announce::NUMBER {
        head.topic = [1, 2, 3, 4, 5, 6, 8, 255][random.usize(..8)];
    }
    let mut buffer = [0; MTU_ETHERNET];
    buffer[HEAD..HEAD + payload.len()].copy_from_slice(&payload);
    head.seal(&mut buffer, payload.len()).expect("it fits").to_vec()
}

/// What `schema` says of a datagram, in the words of the list.
fn expected(bytes: &[u8]) -> Value {
    let sound = Datagram::read(bytes).and_then(|datagram| datagram.check_payload().map(|()| datagram));
    match sound {
        Ok(datagram) => json!({ "head": says::head(&datagram), "payload": says::payload(&datagram) }),
        Err(refusal) => json!({ "refusal": refusal.name() }),
    }
}

fn same(name: &str, bytes: &[u8], mut said: Value, expected: &Value) {
    if let Some(ranges_mm) = said["payload"].as_object_mut().and_then(|payload| payload.remove("mm")) {
        let mut scan = Scan::default();
        assert!(scan.unpack(Datagram::read(bytes).expect("it was read").payload));
        let expected: Vec<i64> =
            (0..scan.beams()).map(|i| scan.distance_mm(i).map_or(-1, i64::from)).collect();
        assert_eq!(ranges_mm, json!(expected), "{name}: {bytes:02x?}");
    }
    // A language without names for them.
    if let Some(counters) = said["payload"]["counters"].as_array() {
        let names = Counter::ALL.iter().map(|counter| counter.name().to_owned());
        let named: Map<String, Value> = names.zip(counters.iter().cloned()).collect();
        said["payload"]["counters"] = named.into();
    }
    for key in ["head", "payload", "refusal"] {
        assert_eq!(said[key], expected[key], "{key} of {name}: {bytes:02x?}");
    }
}
