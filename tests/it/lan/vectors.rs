//! Golden datagrams of `tests/vectors/datagram.json` with their values, for all tests of readers.

use std::fs;
use std::path::Path;

use serde_json::Value;

/// One datagram of the list, whose bytes and values must not change.
pub(crate) struct Vector {
    pub(crate) name: String,
    pub(crate) bytes: Vec<u8>,
    /// Result for the datagram: `head` and `payload` if it is accepted, or `refusal` if it is refused. Some results
    /// depend on a key of the receiver, or on earlier datagrams. The description of such a result also has `with_key`,
    /// `after` (names of the datagrams that the receiver received before), `after_hubs` (number of other hubs that sent
    /// for a second before), or `from_another` (another sender sent the datagrams before).
    pub(crate) description: Value,
}

/// Returns all datagrams in the order of the list.
pub(crate) fn vectors() -> Vec<Vector> {
    read_list()["vectors"].as_array().expect("a list").iter().map(vector).collect()
}

/// Returns the datagram with this name.
pub(crate) fn bytes(name: &str) -> Vec<u8> {
    let found = vectors().into_iter().find(|vector| vector.name == name);
    found.unwrap_or_else(|| panic!("no datagram {name}")).bytes
}

fn vector(description: &Value) -> Vector {
    let text = |key: &str| description[key].as_str().unwrap_or_else(|| panic!("no {key}"));
    Vector { name: text("name").to_owned(), bytes: unhex(text("bytes")), description: description.clone() }
}

fn unhex(text: &str) -> Vec<u8> {
    let digits: Vec<u32> = text.chars().map(|c| c.to_digit(16).expect("the text is hexadecimal")).collect();
    digits.chunks(2).map(|pair| (pair[0] << 4 | pair[1]) as u8).collect()
}

/// Returns the whole list. It has two fields: `vectors`, and `key`, which is the key of the datagrams with a MAC in
/// hexadecimal digits.
pub(crate) fn read_list() -> Value {
    // Crates at several depths of the source tree include this file, so search upward for the root of the tree.
    let mut above = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors();
    let top =
        above.find(|folder| folder.join("tests/vectors").is_dir()).expect("the root of the source tree");
    let text = fs::read_to_string(top.join("tests/vectors/datagram.json")).expect("the list can be read");
    serde_json::from_str(&text).expect("JSON")
}
