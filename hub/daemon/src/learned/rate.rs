//! The rate at which a link's scanner was found the last time that it had to be searched for, as a line of text.
//!
//! After power-on, a scanner has the same rate each time, so a search that starts there saves the timeouts of the other
//! rates. A wrong rate costs only that time.

pub use scanhub_drivers::line::KnownRate;

/// Returns the line for a scanner that was found at `port` at `rate`.
pub(super) fn text(rate: KnownRate, port: &str) -> String {
    let KnownRate { baud, silent_switches } = rate;
    match silent_switches {
        0 => format!("{baud} {port}\n"),
        _ => format!("{baud}{SILENT}{silent_switches} {port}\n"),
    }
}

/// Returns the rate and the port in `text`. Returns `None` if it is cut short.
pub(super) fn read(text: &str) -> Option<(KnownRate, &str)> {
    let (rate, port) = text.strip_suffix('\n')?.split_once(' ')?;
    let (baud, silent_switches) = rate.split_once(SILENT).unwrap_or((rate, "0"));
    Some((KnownRate { baud: baud.parse().ok()?, silent_switches: silent_switches.parse().ok()? }, port))
}

/// Maximum length of such a text in bytes: a rate, and a port, which is at most as long as a path.
pub(super) const LONGEST: u64 = 8_192;

const SILENT: &str = ",silent=";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_what_it_writes_and_rejects_torn_text() {
        let port = "/dev/serial/by-id/usb-FTDI 1";
        for (silent_switches, line) in [(0, "38400 "), (2, "38400,silent=2 ")] {
            let rate = KnownRate { baud: 38_400, silent_switches };
            let text = text(rate, port);
            assert_eq!(
                (read(&text), text.strip_suffix('\n')),
                (Some((rate, port)), Some(&*[line, port].concat()))
            );
        }
        for torn in
            ["", "9600", "9600\n", "x /dev/x\n", "9600 /dev/x", " /dev/x\n", "\n\n", "9600,silent= /x\n"]
        {
            assert_eq!(read(torn), None, "{torn:?}");
        }
    }
}
