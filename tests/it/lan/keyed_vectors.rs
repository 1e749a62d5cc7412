//! The golden datagrams with a MAC, and what a receiver that has the key makes of each, one behind the other.

use std::fs;
use std::path::Path;

use serde_json::Value;

/// What came, in this order.
pub(crate) struct KeyedVectors {
    /// The key of the receiver, as hex digits.
    pub(crate) key: String,
    /// The datagrams.
    pub(crate) steps: Vec<Step>,
}

/// One datagram.
pub(crate) struct Step {
    /// What it is there for.
    pub(crate) name: String,
    /// The receiver's clock when it comes: seconds since 1970.
    pub(crate) at_s: u64,
    /// The datagram.
    pub(crate) bytes: Vec<u8>,
    /// Its MAC is `right` or `wrong`, or there is `none`.
    pub(crate) mac: String,
    /// It is `taken`, a `duplicate`, a `part` that others are needed for, or why it is refused.
    pub(crate) outcome: String,
}

/// All of them.
pub(crate) fn read_vectors() -> KeyedVectors {
    let list: Value = serde_json::from_str(&text()).expect("JSON");
    let word = |step: &Value, key: &str| step[key].as_str().unwrap_or_else(|| panic!("no {key}")).to_owned();
    let step = |step: &Value| Step {
        name: word(step, "name"),
        at_s: step["at_s"].as_u64().expect("a number"),
        bytes: unhex(&word(step, "bytes")),
        mac: word(step, "mac"),
        outcome: word(step, "outcome"),
    };
    let steps = list["steps"].as_array().expect("a list").iter().map(step).collect();
    KeyedVectors { key: word(&list, "key"), steps }
}

/// The file.
pub(crate) fn text() -> String {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let top = here.ancestors().find(|path| path.join("hub").is_dir()).expect("the top");
    fs::read_to_string(top.join("tests/vectors/keyed.json")).expect("the list")
}

/// The bytes of hex digits.
pub(crate) fn unhex(digits: &str) -> Vec<u8> {
    let digit = |c: char| c.to_digit(16).expect("hex") as u8;
    let digits: Vec<u8> = digits.chars().map(digit).collect();
    digits.chunks(2).map(|pair| pair[0] << 4 | pair[1]).collect()
}
