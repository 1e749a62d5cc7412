//! Reads a log or a stream through, and says what is in it. Refuses to know how it was opened.

use std::io::{BufRead, Read};
use std::path::Path;

use schema::{Failure, Family, Kind};

use crate::carmen::{Census, Log, Wrong};
use crate::open::{is_end, reader, unreadable};
use crate::packets::Packets;
use crate::stream::Telegrams;
use crate::{Contents, Form};

/// What is in the log at `path`.
pub(crate) fn survey_log(path: &Path, reader: impl BufRead) -> Result<Contents, Failure> {
    let mut contents = Contents::new(Form::Carmen);
    let (mut log, mut census, mut refusal) = (Log::new(reader), Census::default(), None);
    loop {
        match log.next() {
            Ok(Some(sweep)) => {
                contents.note_scan(sweep.variant(), sweep.time_ns);
                census.note(&sweep.ranges_m);
            }
            Ok(None) => break,
            Err(Wrong::File(error)) if is_end(&error) && contents.scans > 0 => {
                contents.damage.is_cut = true;
                break;
            }
            Err(Wrong::File(error)) => return Err(unreadable(path, &error)),
            Err(Wrong::Line(wrong)) => {
                let message = format!("{}:{}: {wrong}", path.display(), log.line);
                let hint = "a scan is: FLASER 361 RANGE... in metres";
                refusal.get_or_insert(Failure::new(Kind::Input, message, hint));
                contents.damage.telegrams += 1;
                contents.damage.is_harmed = true;
            }
        }
    }
    contents.unread = log.unread;
    let (encoding, unfit) = census.encoding(log.told);
    (contents.unit, contents.mode, contents.unfit) = (Some(encoding.unit), Some(encoding.mode), unfit);
    // Where no line is right it is the format that is wrong, not the file.
    match refusal.filter(|_| contents.scans == 0) {
        Some(refusal) => Err(refusal),
        None => Ok(contents),
    }
}

/// What telegrams of an LMS are in the stream at `path`.
pub(crate) fn survey_stream(path: &Path, reader: impl Read) -> Result<Contents, Failure> {
    let mut contents = Contents::new(Form::Telegrams);
    let mut telegrams = Telegrams::new(reader);
    loop {
        match telegrams.next() {
            Ok(Some(bytes)) => contents.note(Family::Lms as u8, &bytes, None),
            Ok(None) => break,
            Err(error) if is_end(&error) && contents.telegrams > 0 => {
                contents.damage.is_cut = true;
                break;
            }
            Err(error) => return Err(unreadable(path, &error)),
        }
    }
    contents.damage.bytes = telegrams.discarded();
    Ok(contents)
}

/// What is in the stream at `path`, in which there is no telegram of an LMS, of the family of which most of it is; nothing
/// if there is none of any.
pub(crate) fn survey_packets(path: &Path) -> Result<Option<Contents>, Failure> {
    let mut best: Option<(u64, Contents)> = None;
    for family in Family::ALL {
        let Some(mut packets) = Packets::of(family, reader(path)?) else { continue };
        let (mut contents, mut bytes) = (Contents::new(Form::Telegrams), 0);
        loop {
            match packets.next() {
                Ok(Some(frame)) => {
                    contents.note(frame.family, &frame.telegram, None);
                    contents.scanner_ns = frame.scanner_ns;
                    bytes += frame.telegram.len() as u64;
                }
                Ok(None) => break,
                Err(error) if is_end(&error) && contents.telegrams > 0 => {
                    contents.damage.is_cut = true;
                    break;
                }
                Err(error) => return Err(unreadable(path, &error)),
            }
        }
        contents.damage.bytes = packets.discarded();
        if bytes > best.as_ref().map_or(BY_CHANCE, |(bytes, _)| *bytes) {
            best = Some((bytes, contents));
        }
    }
    Ok(best.map(|(_, contents)| contents))
}

/// So many bytes of packets may be noise that passed a short checksum.
const BY_CHANCE: u64 = 100;
