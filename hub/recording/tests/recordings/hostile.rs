//! Tests of records with wrong lengths and contents. Whatever attachments, metadata and indices contain, all telegrams
//! of the file are read and copied, and nothing panics.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use fastrand::Rng;
use mcap::records::op;
use scanhub_recording::convert::{ConversionResult, ConvertOptions, convert};
use scanhub_schema::{Failure, Kind};
use tempfile::TempDir;

/// Converts the file `bytes` to MCAP in `folder`.
fn convert_again(folder: &TempDir, bytes: &[u8]) -> Result<ConversionResult, Failure> {
    let (input, output) = (folder.path().join("in.mcap"), copy(folder));
    fs::write(&input, bytes).unwrap();
    let options = ConvertOptions { input, output, force: true, ..ConvertOptions::default() };
    convert(&options, &AtomicBool::new(false), |_, _| {})
}

/// Returns the path of the converted file.
fn copy(folder: &TempDir) -> PathBuf {
    folder.path().join("out.mcap")
}

fn record(opcode: u8, body: &[u8]) -> Vec<u8> {
    [&[opcode][..], &(body.len() as u64).to_le_bytes(), body].concat()
}

fn text(text: &str) -> Vec<u8> {
    [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat()
}

fn attachment(data: &[u8]) -> Vec<u8> {
    let len = (data.len() as u64).to_le_bytes();
    [&[7; 16][..], &text("map.pgm"), &text("image/pgm"), &len, data, &[0; 4]].concat()
}

/// Returns opcode and body of records of each kind that a file can have in addition to its messages.
fn foreign_records() -> Vec<(u8, Vec<u8>)> {
    let pairs = [text("robot"), text("r1"), text("place"), text("hall 3")].concat();
    let map = [&(pairs.len() as u32).to_le_bytes()[..], &pairs].concat();
    let counted = |entries: &[u8]| [&(entries.len() as u32).to_le_bytes()[..], entries].concat();
    vec![
        (op::ATTACHMENT, attachment(b"")),
        (op::ATTACHMENT, attachment(b"P5 2 2 255 abcd")),
        (op::METADATA, [text("walk"), map].concat()),
        (op::MESSAGE_INDEX, [&[1, 0][..], &counted(&[0; 32])].concat()),
        (op::CHUNK_INDEX, [&[0; 32][..], &counted(&[1; 20]), &[0; 8], &text(""), &[0; 16]].concat()),
        (op::ATTACHMENT_INDEX, [&[0; 40][..], &text("map.pgm"), &text("image/pgm")].concat()),
        (op::METADATA_INDEX, [&[0; 16][..], &text("walk")].concat()),
        (op::STATISTICS, [&[0; 42][..], &counted(&[1; 20])].concat()),
        (op::SUMMARY_OFFSET, vec![op::STATISTICS; 17]),
    ]
}

/// Returns a recording with `record` before its first chunk, and section checksums of 0.
fn with_record(recording: &[u8], record: &[u8]) -> Vec<u8> {
    let (mut at, mut file) = (MAGIC_LEN, recording[..MAGIC_LEN].to_vec());
    let mut is_in = false;
    while at + 9 < recording.len() - MAGIC_LEN {
        let len = u64::from_le_bytes(*recording[at + 1..].first_chunk().unwrap()) as usize;
        let (opcode, end) = (recording[at], at + 9 + len);
        if opcode == op::CHUNK && !is_in {
            file.extend_from_slice(record);
            is_in = true;
        }
        file.extend_from_slice(&recording[at..end]);
        let place = file.len();
        match opcode {
            op::DATA_END => file[place - 4..].fill(0),
            op::FOOTER => file[place - 20..].fill(0),
            _ => {}
        }
        at = end;
    }
    file.extend_from_slice(&recording[at..]);
    file
}

const MAGIC_LEN: usize = 8;

#[test]
fn reports_and_drops_a_truncated_attachment() {
    let folder = TempDir::new().unwrap();
    let whole = crate::written::recording(8, 1);
    let telegrams = whole.telegrams.len() as u64;
    let sound =
        convert_again(&folder, &with_record(&whole.bytes, &record(op::ATTACHMENT, &attachment(b"abc"))))
            .unwrap();
    assert!(sound.damage.is_none() && sound.telegrams == telegrams, "{sound:?}");
    assert_eq!(attachments(&copy(&folder)), 1);
    // Try all shorter lengths. An attachment that is 1 to 4 bytes shorter lacks a part of its checksum or all of it.
    for data in [&b""[..], b"abc"] {
        let body = attachment(data);
        for len in 0..body.len() {
            let cut = record(op::ATTACHMENT, &body[..len]);
            let converted = convert_again(&folder, &with_record(&whole.bytes, &cut)).unwrap();
            assert_eq!(converted.telegrams, telegrams, "{len}: {converted:?}");
            assert!(converted.damage.bytes > 0 && converted.damage.is_damaged, "{len}: {converted:?}");
            assert_eq!(attachments(&copy(&folder)), 0, "{len}");
        }
    }
}

fn attachments(path: &Path) -> u32 {
    let file = fs::read(path).unwrap();
    mcap::Summary::read(&file).unwrap().unwrap().stats.unwrap().attachment_count
}

#[test]
fn malformed_record_never_panics_or_costs_a_telegram() {
    let folder = TempDir::new().unwrap();
    let whole = crate::written::recording(4, 2);
    let telegrams = whole.telegrams.len() as u64;
    let (mut random, others) = (Rng::with_seed(3), foreign_records());
    for round in 0..400 {
        let (opcode, mut body) = others[random.usize(..others.len())].clone();
        for _ in 0..random.usize(1..4) {
            let at = random.usize(..=body.len());
            match random.u8(..4) {
                0 => body.truncate(at),
                1 => body.insert(at, random.u8(..)),
                // Four bytes of a record are often a length, so write a small number into them.
                2 if at + 4 <= body.len() => {
                    body[at..at + 4].copy_from_slice(&random.u32(..64).to_le_bytes())
                }
                _ if at < body.len() => body[at] = random.u8(..),
                _ => {}
            }
        }
        let file = with_record(&whole.bytes, &record(opcode, &body));
        match convert_again(&folder, &file) {
            Ok(converted) => assert_eq!(converted.telegrams, telegrams, "{round}: {opcode} {body:?}"),
            Err(failure) => assert_eq!(failure.kind, Kind::Configuration, "{round}: {opcode} {body:?}"),
        }
    }
}
