//! At which rate the sensor of a link was found the last time that it had to be sought, as a line of text: a sensor that
//! gets its power is at the same rate each time, and whoever asks there first saves the time of an answer that does not
//! come. Refuses to know how a sensor is sought; a wrong rate costs that time, and nothing else.

/// The line for a sensor that was found at `port` at `rate`.
pub(super) fn text(rate: u32, port: &str) -> String {
    format!("{rate} {port}\n")
}

/// Rate and port in `text`; nothing if it is cut short.
pub(super) fn read(text: &str) -> Option<(u32, &str)> {
    let (rate, port) = text.strip_suffix('\n')?.split_once(' ')?;
    Some((rate.parse().ok()?, port))
}

/// Bytes of such a text: a rate, and a port, which has a path's length at the most.
pub(super) const LONGEST: u64 = 8_192;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read_and_what_is_torn_is_not() {
        let port = "/dev/serial/by-id/usb-FTDI 1";
        assert_eq!(read(&text(38_400, port)), Some((38_400, port)));
        for torn in ["", "9600", "9600\n", "x /dev/x\n", "9600 /dev/x", " /dev/x\n", "\n\n"] {
            assert_eq!(read(torn), None, "{torn:?}");
        }
    }
}
