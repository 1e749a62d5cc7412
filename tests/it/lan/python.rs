//! Python module for datagrams, compared with the golden datagrams and with `schema`. The tests are skipped if python3
//! is not installed. The part that needs numpy is skipped separately.

use std::path::Path;
use std::process::Command;

use crate::testkit::{output, skip, succeeds};

use super::readers::{self, Reader};
use super::vectors;

/// Starts the reader in the Python interpreter of `SCANHUB_PYTHON`, or in `python3`.
fn reader() -> Option<Reader> {
    let top = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = std::env::var("SCANHUB_PYTHON").unwrap_or("python3".to_owned());
    let recent = "import sys; sys.exit(sys.version_info < (3, 9))";
    if !succeeds(Command::new(&python).args(["-c", recent])) {
        skip("python", format!("there is no {python}, or it is older than 3.9"));
        return None;
    }
    let mut command = Command::new(python);
    command.arg("-B").arg(top.join("tests/it/lan/reader.py")).env("PYTHONPATH", top.join("clients/python"));
    Some(Reader::start(&mut command))
}

#[test]
fn module_reads_the_same_datagrams_as_schema() {
    let Some(mut reader) = reader() else { return };
    readers::check_vectors(&mut reader);
    readers::check_keyed_vectors(&mut reader);
    readers::check_damaged(&mut reader, 5_000);
    reader.end();
}

#[test]
fn module_reassembles_parts() {
    if reader().is_none() {
        return;
    }
    let hex = |name: &str| vectors::bytes(name).iter().map(|byte| format!("{byte:02x}")).collect::<String>();
    let [scan, first, second, last] = ["scan", "scan_part_0", "scan_part_1", "scan_part_2"].map(hex);
    for (order, whole) in [
        (&[&first, &second, &last][..], &scan[96..]),
        (&[&last, &first, &second], &scan[96..]),
        (&[&last, &last, &second, &first], &scan[96..]),
        (&[&first, &second, &first], ""),
        (&[&scan], &scan[96..]),
    ] {
        let top = Path::new(env!("CARGO_MANIFEST_DIR"));
        let mut command = Command::new(std::env::var("SCANHUB_PYTHON").unwrap_or("python3".to_owned()));
        command.arg("-B").arg(top.join("tests/it/lan/reader.py")).args(order);
        let output = output(command.env("PYTHONPATH", top.join("clients/python"))).expect("the program runs");
        assert_eq!(String::from_utf8_lossy(&output.stdout).trim(), whole, "{output:?}");
    }
}

#[test]
fn module_checks_macs_with_a_key() {
    let Some(mut reader) = reader() else { return };
    let list = vectors::read_list();
    let key = list["key"].as_str().expect("a key");
    for vector in vectors::vectors() {
        let message = reader.read(Some(key), &vector.bytes);
        if vector.description["with_key"] == true {
            assert_eq!(message["refusal"], vector.description["refusal"], "{}", vector.name);
        }
        assert_eq!(message["authenticated"] == true, vector.name == "authenticated", "{}", vector.name);
    }
    reader.end();
}
