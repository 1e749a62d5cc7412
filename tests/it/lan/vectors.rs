//! The golden datagrams and what each of them says, for everyone who reads datagrams.

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;

/// One of them.
pub(crate) struct Vector {
    /// Its file, such as `scan.hex`.
    pub(crate) file: String,
    /// The datagram.
    pub(crate) bytes: Vec<u8>,
    /// `head` and `payload`, or `refusal` and, where one is needed, how it comes to that: `with_key`, `after` (files
    /// that were received before), `after_hubs` (so many other hubs delivered for a second before),
    /// `from_another` (another sender than that of what was received before).
    pub(crate) says: Value,
}

/// All of them, in the order of the list.
pub(crate) fn vectors() -> Vec<Vector> {
    let list = list();
    let vectors: Vec<Vector> = list["vectors"].as_array().expect("a list").iter().map(vector).collect();
    let files = fs::read_dir(directory()).expect("a readable directory").count();
    assert_eq!(files, vectors.len() + 1, "every file of the directory is in the list");
    vectors
}

/// The bytes of one file.
pub(crate) fn bytes(file: &str) -> Vec<u8> {
    let path = directory().join(file);
    let text = fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    unhex(&text)
}

fn vector(says: &Value) -> Vector {
    let file = says["file"].as_str().expect("a file").to_owned();
    Vector { bytes: bytes(&file), file, says: says.clone() }
}

fn unhex(text: &str) -> Vec<u8> {
    let digits: Vec<u32> =
        text.chars().filter(|c| !c.is_whitespace()).map(|c| c.to_digit(16).expect("hex")).collect();
    digits.chunks(2).map(|pair| (pair[0] << 4 | pair[1]) as u8).collect()
}

/// The whole list: `vectors`, and `key`, as hex digits, of those that have one.
pub(crate) fn list() -> Value {
    let text = fs::read_to_string(directory().join("vectors.json")).expect("the list");
    serde_json::from_str(&text).expect("JSON")
}

fn directory() -> PathBuf {
    // Crates at several depths read them.
    let mut above = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors();
    let top = above.find(|folder| folder.join("tests/vectors").is_dir()).expect("the top");
    top.join("tests/vectors/datagram")
}
