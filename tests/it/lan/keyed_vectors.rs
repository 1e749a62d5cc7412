//! Golden datagrams with a MAC, and the result with which a receiver handles each of them. The receiver has the key,
//! and receives the datagrams in the order of the list.

use std::fs;
use std::path::Path;

use serde_json::Value;

/// Key, and datagrams of the list in `tests/vectors/keyed.json`.
pub(crate) struct KeyedVectors {
    /// Key of the receiver, in hexadecimal digits.
    pub(crate) key: String,
    /// Datagrams in the order in which the receiver gets them.
    pub(crate) steps: Vec<Step>,
}

/// One datagram, and the result with which the receiver handles it.
pub(crate) struct Step {
    /// Purpose of the datagram.
    pub(crate) name: String,
    /// Receiver's clock when the datagram arrives, in seconds since 1970.
    pub(crate) at_s: u64,
    /// Bytes of the datagram.
    pub(crate) bytes: Vec<u8>,
    /// State of the MAC: `right`, `wrong` or `none`.
    pub(crate) mac: String,
    /// Result: `taken`, `duplicate`, `part` (other parts are missing), or the reason why the datagram is refused.
    pub(crate) outcome: String,
}

/// Reads the list.
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

/// Returns the text of the file with the list.
pub(crate) fn text() -> String {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let top = here.ancestors().find(|path| path.join("hub").is_dir()).expect("the root of the source tree");
    fs::read_to_string(top.join("tests/vectors/keyed.json")).expect("the list can be read")
}

/// Decodes hexadecimal digits.
pub(crate) fn unhex(digits: &str) -> Vec<u8> {
    let digit = |c: char| c.to_digit(16).expect("the text is hexadecimal") as u8;
    let digits: Vec<u8> = digits.chars().map(digit).collect();
    digits.chunks(2).map(|pair| pair[0] << 4 | pair[1]).collect()
}
