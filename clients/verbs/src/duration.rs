//! Durations on the command line: a number with one unit, such as `10s`, `250ms` or `5m`.

use std::time::Duration;

/// Parses a duration: a number, which may have a fraction, and `us`, `ms`, `s`, `m` or `h`.
///
/// # Errors
///
/// Returns a message for the user if `text` is not a duration, or is longer than a year.
pub fn parse(text: &str) -> Result<Duration, String> {
    let wrong = || format!("{text:?} is not a duration: write it like 10s, 250ms or 5m");
    let unit = text.find(|c: char| c.is_ascii_alphabetic()).ok_or_else(wrong)?;
    let (number, unit) = text.split_at(unit);
    let digits = number.chars().all(|c| c.is_ascii_digit() || c == '.');
    let number: f64 = number.parse().ok().filter(|_| digits).ok_or_else(wrong)?;
    let seconds = match unit {
        "us" => 1e-6,
        "ms" => 1e-3,
        "s" => 1.0,
        "m" => 60.0,
        "h" => 3600.0,
        _ => return Err(wrong()),
    };
    match Duration::try_from_secs_f64(number * seconds) {
        Ok(duration) if duration <= MAX_DURATION => Ok(duration),
        _ => Err(format!("{text:?} is too long: a year, 8760h, at most")),
    }
}

/// Maximum duration: one year. It can be added to any time without an overflow.
const MAX_DURATION: Duration = Duration::from_secs(365 * 24 * 3600);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_one_number_with_one_unit() {
        assert_eq!(parse("10s"), Ok(Duration::from_secs(10)));
        assert_eq!(parse("250ms"), Ok(Duration::from_millis(250)));
        assert_eq!(parse("5m"), Ok(Duration::from_secs(300)));
        assert_eq!(parse("1.5s"), Ok(Duration::from_millis(1500)));
        assert_eq!(parse("0s"), Ok(Duration::ZERO));
        for bad in
            ["", "10", "s", "-1s", "1d", "1 s", "1e3s", "infs", "1s1ms", "99999999999999999999h", "8761h"]
        {
            assert!(parse(bad).is_err(), "{bad}");
        }
    }
}
