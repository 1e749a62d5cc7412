//! Causes and remedies for Zenoh's messages about failed connections. The texts are those of Zenoh 1.10. The version of
//! Zenoh is pinned, so the texts stay valid.

/// A cause and its remedy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Diagnosis {
    pub(crate) finding: &'static str,
    pub(crate) remedy: &'static str,
}

impl Diagnosis {
    /// Returns the cause that Zenoh's message `words` indicates, if it is known.
    pub(crate) fn of(words: &str) -> Option<Diagnosis> {
        let words = words.to_lowercase();
        let has_any = |signs: &[&str]| signs.iter().any(|sign| words.contains(sign));
        let find = |known: &[KnownCause]| known.iter().find(|(signs, _)| has_any(signs)).map(|row| row.1);
        // Only the side that connects logs this text.
        let connects = words.contains("unable to connect");
        let of_certificate =
            || find(CERTIFICATE_CAUSES).map(|known| if connects { known } else { PEER_REFUSED });
        find(KNOWN_CAUSES).or_else(of_certificate).or(connects.then_some(UNREACHED))
    }
}

/// Default cause, used if a message of the side that connects indicates no other cause: no program replies at the
/// address, or the program does not use Zenoh's protocol.
pub(crate) const UNREACHED: Diagnosis = Diagnosis {
    finding: "no router is reached",
    remedy: "start a router there (`scanhub bridge --listen ..` or zenohd), and check the firewall",
};

/// Parts of Zenoh's messages in lower case, and the cause of these messages. The first entry that matches is used.
type KnownCause = (&'static [&'static str], Diagnosis);

const KNOWN_CAUSES: &[KnownCause] = &[
    (
        &["recv opensyn. invalid", "recv initsyn. expected"],
        Diagnosis {
            finding: "a client was refused: its user or password is wrong or missing",
            remedy: "list the users in transport/auth/usrpwd/dictionary_file of this machine, one USER:PASSWORD per line",
        },
    ),
    (
        &["in response to an opensyn", "usrpwd", "authenticat", "password"],
        Diagnosis {
            finding: "the router refused the user or the password",
            remedy: "compare transport/auth/usrpwd here with the router's dictionary_file",
        },
    ),
    (
        &["(reason 0) in response to an initsyn"],
        Diagnosis {
            finding: "the router requires a user and a password",
            remedy: "set transport/auth/usrpwd/user and password in the file of --config",
        },
    ),
    (
        &["unable to push non droppable"],
        Diagnosis {
            finding: "a connected program has read nothing for 5 s, so its link was closed",
            remedy: "check whether it is stopped, or its network is too slow; it connects again by itself",
        },
    ),
    (
        &["too many open files"],
        Diagnosis {
            finding: "a connection was not accepted: no file descriptor is left",
            remedy: "allow more: `ulimit -n 4096` in the shell, or LimitNOFILE=4096 in the unit of a service",
        },
    ),
];

/// Certificate errors, as the side that connects reports them.
const CERTIFICATE_CAUSES: &[KnownCause] = &[
    (
        &["expired"],
        Diagnosis {
            finding: "a certificate has expired",
            remedy: "renew the router's certificate, or this machine's; `openssl x509 -enddate` shows the date of each",
        },
    ),
    (
        &["notvalidyet", "not valid yet"],
        Diagnosis {
            finding: "a certificate is not valid yet",
            remedy: "set the clock of this machine, or of the one that created the certificate",
        },
    ),
    (
        &["certificate", "unknownissuer", "unknownca", "tls"],
        Diagnosis {
            finding: "the certificates do not match",
            remedy: "root_ca_certificate must be the authority that signed the router's certificate, and --connect must name the \
                     router as its certificate does; a router with enable_mtls needs a connect_certificate",
        },
    ),
];

/// Certificate error, as the side that listens reports it.
const PEER_REFUSED: Diagnosis = Diagnosis {
    finding: "a client was refused: the certificates do not match",
    remedy: "a machine that connects must trust the authority of listen_certificate here; with enable_mtls, it must \
             also show a connect_certificate of the authority in root_ca_certificate here, which has not expired",
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_zenoh_errors_have_a_remedy() {
        for (words, finding, remedy) in [
            ("Unable to connect to tls/r:1! invalid peer certificate: Expired", "has expired", "renew"),
            ("Unable to connect to tls/r:1! invalid peer certificate: NotValidYet", "not valid yet", "clock"),
            ("Unable to connect to tls/r:1! received fatal alert: UnknownCA", "do not match", "--connect"),
            (
                "Received a close message (reason GENERIC) in response to an OpenSyn on: TransportLinkUnicast",
                "the router refused the user or the password",
                "dictionary_file",
            ),
            (
                "Received a close message (reason 0) in response to an InitSyn on: tcp/127.0.0.1:1",
                "requires a user",
                "usrpwd/user",
            ),
            ("UsrPwd extension - Recv OpenSyn. Invalid password.", "a client was refused", "dictionary_file"),
            ("invalid peer certificate: Expired.", "a client was refused", "connect_certificate"),
            ("received fatal alert: UnknownCA.", "a client was refused", "listen_certificate"),
            (
                "Unable to push non droppable network message to 1a2b. Closing transport!",
                "read nothing for 5 s",
                "connects again",
            ),
            ("Too many open files (os error 24)", "no file descriptor", "ulimit"),
            ("Unable to connect to tcp/r:1! Connection refused (os error 111)", "no router", "firewall"),
        ] {
            let known = Diagnosis::of(words).unwrap_or_else(|| panic!("{words}"));
            assert!(known.finding.contains(finding) && known.remedy.contains(remedy), "{words}: {known:?}");
        }
        assert_eq!(Diagnosis::of("New moon"), None);
    }
}
