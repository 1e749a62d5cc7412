//! `scanhub telegram`: explains the telegrams of an LMS in a recording, in a stream of bytes, or in hexadecimal text.

mod find;
mod input;
mod show;

use std::io::{self, ErrorKind, Read, Write};
use std::path::{Path, PathBuf};

use scanhub_drivers::lms::variant::Mode;
use scanhub_files::regular;
use schema::{Failure, Kind};

use find::Finder;
use input::{Input, is_framed, open_recording};
use show::{Form, Show};

/// Options of `telegram decode`.
#[derive(Clone, Debug, Default)]
pub struct DecodeOptions {
    /// The file to read; `None` or `-` is stdin.
    pub file: Option<PathBuf>,
    /// Of a recording of several sensors the one whose telegrams are meant.
    pub sensor: Option<String>,
    /// The measuring mode, as `0x01` or `1`; without it, the mode in the telegrams.
    pub mode: Option<String>,
    /// Every value instead of a summary.
    pub all: bool,
    /// One JSON object a line.
    pub json: bool,
}

/// Explains all telegrams in a stream of bytes, in hexadecimal text or inside an MCAP recording, and accounts for the
/// bytes between them. Bytes of a recording are those of its telegrams, in order.
///
/// [`Kind::Check`] if there is no telegram in it, [`Kind::Input`] if it cannot be read; [`Kind::NoTopic`] and
/// [`Kind::Usage`] if it has no such sensor, or several and none is chosen.
pub fn decode(options: &DecodeOptions, out: &mut dyn Write) -> Result<(), Failure> {
    let said = options.mode.as_deref().map(parse_mode).transpose()?;
    let file = options.file.as_deref().filter(|path| *path != Path::new("-"));
    let name = file.map_or("stdin".into(), |path| path.display().to_string());
    let (reader, told): (Box<dyn Read>, _) = match (file, &options.sensor) {
        (Some(path), sensor) if sensor.is_some() || is_framed(path) => {
            open_recording(path, sensor.as_deref())?
        }
        (Some(path), _) => (Box::new(regular::open(path).map_err(|error| unreadable(&name, &error))?), None),
        (None, None) => (Box::new(io::stdin()), None),
        (None, Some(_)) => {
            let hint = "for example `scanhub telegram decode walk.mcap --sensor front`";
            return Err(Failure::new(
                Kind::Usage,
                "--sensor selects a sensor of a recording, and stdin is not one",
                hint,
            ));
        }
    };
    let mode = said.or(told);
    let mut input = Input::new(reader).map_err(|error| unreadable(&name, &error))?;
    let form = match (options.json, options.all) {
        (true, _) => Form::Json,
        (false, all) => Form::Text { all },
    };
    let mut show = Show::new(out, form, mode);
    let mut finder = Finder::default();
    let mut ended = Ok(());
    while ended.is_ok() {
        match input.next().map_err(|error| unreadable(&name, &error))? {
            Some(bytes) => ended = finder.feed(bytes, &mut |offset, item| show.item(offset, item)),
            None => {
                ended = finder.end(&mut |offset, item| show.item(offset, item)).and_then(|()| show.summary());
                break;
            }
        }
    }
    match ended {
        // Whoever read does not any more: normal use of a pipe.
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
        Err(error) => Err(Failure::new(Kind::Failed, format!("cannot write: {error}"), "")),
        Ok(()) if show.telegrams() == 0 => {
            let message = format!("{name}: no telegram in {} bytes", show.bytes());
            let hint = "expected: raw bytes of an LMS, or text such as 02 00 01 00 31 15 12; packets of other families are \
                        not explained here: `scanhub convert FILE OUT.csv` has their scans";
            Err(Failure::new(Kind::Check, message, hint))
        }
        Ok(()) => Ok(()),
    }
}

/// Parses a measuring mode: `1`, `0x01` or `01h`.
fn parse_mode(text: &str) -> Result<Mode, Failure> {
    let hex = text.strip_prefix("0x").or(text.strip_prefix("0X")).or(text.strip_suffix(['h', 'H']));
    let (digits, radix) = hex.map_or((text, 10), |digits| (digits, 16));
    // `from_str_radix` accepts a sign.
    let byte = u8::from_str_radix(digits, radix).ok().filter(|_| !digits.starts_with('+'));
    byte.map(Mode).ok_or_else(|| {
        Failure::new(Kind::Configuration, format!("mode {text:?} is not a byte"), "for example --mode 0x01")
    })
}

fn unreadable(name: &str, error: &io::Error) -> Failure {
    let hint = match error.kind() {
        ErrorKind::Unsupported => "name its file: scanhub telegram decode FILE",
        ErrorKind::InvalidData => "write pairs of digits, as 02 80 03 00 or 0x02,0x80; text between quotes",
        _ => "name a readable file, or - for stdin",
    };
    Failure::new(Kind::Input, format!("{name}: {error}"), hint)
}
