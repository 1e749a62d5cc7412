//! Files of certificates and keys, read before Zenoh does: it opens them only when it connects, and of one's own certificate
//! that has expired it tells what the other side says. Refuses to know who signed what, and the clock: time is an argument.

use x509_parser::pem::Pem;

/// Why a file cannot be used, and what to do.
pub(super) struct Unusable {
    pub(super) why: String,
    pub(super) remedy: &'static str,
}

/// Checks that the first certificate in `text`, which this machine shows, is valid `now_s` seconds after 1970.
pub(super) fn check_own(text: &[u8], now_s: i64) -> Result<(), Unusable> {
    judge(&certificates(text)?[0], now_s)
}

/// Checks that one of the certificates in `text`, which this machine trusts, is valid `now_s` seconds after 1970: a list of
/// many may have old ones.
pub(super) fn check_trusted(text: &[u8], now_s: i64) -> Result<(), Unusable> {
    let certificates = certificates(text)?;
    let is_good = certificates[1..].iter().any(|block| judge(block, now_s).is_ok());
    judge(&certificates[0], now_s).or_else(|unusable| if is_good { Ok(()) } else { Err(unusable) })
}

/// Checks that `text` has a private key.
pub(super) fn check_key(text: &[u8]) -> Result<(), Unusable> {
    if blocks(text)?.iter().any(|block| block.label.ends_with("PRIVATE KEY")) {
        return Ok(());
    }
    Err(Unusable { why: "there is no private key in it".into(), remedy: NO_PEM })
}

/// What to do about a file that has not what it has to have.
const NO_PEM: &str = "it has to be a file in PEM, as openssl writes it (docs/bridge.md)";

/// One at least.
fn certificates(text: &[u8]) -> Result<Vec<Pem>, Unusable> {
    let mut blocks = blocks(text)?;
    blocks.retain(|block| block.label == "CERTIFICATE");
    if blocks.is_empty() {
        return Err(Unusable { why: "there is no certificate in it".into(), remedy: NO_PEM });
    }
    Ok(blocks)
}

fn judge(block: &Pem, now_s: i64) -> Result<(), Unusable> {
    let certificate = block.parse_x509().map_err(|error| {
        let why = format!("it has a certificate that cannot be read: {error}");
        Unusable { why, remedy: NO_PEM }
    })?;
    let (validity, who) = (certificate.validity(), certificate.subject());
    if now_s > validity.not_after.timestamp() {
        let why = format!("the certificate of {who} expired at {}", validity.not_after);
        return Err(Unusable { why, remedy: "renew it, as docs/bridge.md shows" });
    }
    if now_s < validity.not_before.timestamp() {
        let why = format!("the certificate of {who} is not valid before {}", validity.not_before);
        return Err(Unusable { why, remedy: "set the clock of this machine, or of the one that made it" });
    }
    Ok(())
}

fn blocks(text: &[u8]) -> Result<Vec<Pem>, Unusable> {
    let blocks: Result<Vec<Pem>, _> = Pem::iter_from_buffer(text).collect();
    blocks.map_err(|error| Unusable { why: format!("it cannot be read: {error}"), remedy: NO_PEM })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Made by openssl: from 2026-01-01 to 2026-01-02, for CN=robot.
    const CERTIFICATE: &[u8] = include_bytes!("certificate/expired.pem");
    /// 2026-01-01, in seconds.
    const SINCE_S: i64 = 1_767_225_600;
    const DAY_S: i64 = 86_400;

    #[test]
    fn a_certificate_is_good_from_its_first_to_its_last_second() {
        let refused = |now_s| check_own(CERTIFICATE, now_s).err().map(|unusable| unusable.why);
        assert_eq!([SINCE_S, SINCE_S + DAY_S].map(refused), [None, None]);
        let expired = refused(SINCE_S + DAY_S + 1).unwrap();
        assert_eq!(expired, "the certificate of CN=robot expired at Jan  2 00:00:00 2026 +00:00");
        let early = refused(SINCE_S - 1).unwrap();
        assert_eq!(early, "the certificate of CN=robot is not valid before Jan  1 00:00:00 2026 +00:00");
    }

    #[test]
    fn what_is_no_certificate_or_no_key_is_told() {
        let why = |unusable: Result<(), Unusable>| unusable.err().map(|unusable| unusable.why);
        assert_eq!(why(check_key(CERTIFICATE)).as_deref(), Some("there is no private key in it"));
        let key = b"-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----\n";
        assert_eq!(why(check_key(key)), None);
        let none = why(check_trusted(key, SINCE_S));
        assert_eq!(none.as_deref(), Some("there is no certificate in it"));
        assert!(why(check_trusted(b"nonsense\n", SINCE_S)).is_some());
        let cut = &CERTIFICATE[..CERTIFICATE.len() / 2];
        assert!(why(check_trusted(cut, SINCE_S)).is_some());
        let torn = b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n";
        assert!(why(check_trusted(torn, SINCE_S)).unwrap().contains("cannot be read"));
    }
}
