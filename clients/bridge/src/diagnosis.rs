//! What Zenoh's words about a connection that did not come about mean, and what to do. Its words are those of 1.10, whose
//! version is pinned. Refuses to know whom they are told.

/// What is wrong, and what to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Diagnosis {
    pub(crate) finding: &'static str,
    pub(crate) remedy: &'static str,
}

impl Diagnosis {
    /// What `words` mean; nothing if that is not known.
    pub(crate) fn of(words: &str) -> Option<Diagnosis> {
        let words = words.to_lowercase();
        let is_in = |(signs, _): &&(&[&str], Diagnosis)| signs.iter().any(|sign| words.contains(sign));
        KNOWN.iter().find(is_in).map(|(_, diagnosis)| *diagnosis)
    }
}

/// Nobody answers, or nobody that speaks so.
pub(crate) const UNREACHED: Diagnosis = Diagnosis {
    finding: "no router is reached",
    remedy: "start a router there (`scanhub bridge --listen ..` or zenohd), and check the firewall",
};

/// Parts of what is said, in lower case, and what they mean. The first that fits does: what is said of users and certificates says
/// also that nobody is connected.
const KNOWN: &[(&[&str], Diagnosis)] = &[
    (
        &["recv opensyn. invalid", "recv initsyn. expected"],
        Diagnosis {
            finding: "somebody was refused: the user or the password is wrong, or there is none",
            remedy: "who may connect is in transport/auth/usrpwd/dictionary_file here, a line USER:PASSWORD each",
        },
    ),
    (
        &["in response to an opensyn", "usrpwd", "authenticat", "password"],
        Diagnosis {
            finding: "the user or the password is refused",
            remedy: "compare transport/auth/usrpwd here with the router's dictionary_file",
        },
    ),
    (
        &["(reason 0) in response to an initsyn"],
        Diagnosis {
            finding: "the router wants a user and a password",
            remedy: "set transport/auth/usrpwd/user and password in the file of --config",
        },
    ),
    (
        &["expired"],
        Diagnosis {
            finding: "a certificate has expired",
            remedy: "renew it: the router's, or this machine's, whose date `openssl x509 -enddate` shows",
        },
    ),
    (
        &["notvalidyet", "not valid yet"],
        Diagnosis {
            finding: "a certificate is not valid yet",
            remedy: "set the clock of this machine, or of the one that made it",
        },
    ),
    (
        &["certificate", "unknownissuer", "unknownca", "tls"],
        Diagnosis {
            finding: "the certificates do not fit",
            remedy: "root_ca_certificate must be of who signed the router's certificate, whose name must be in --connect; a router \
                     that wants one of this machine is shown connect_certificate",
        },
    ),
    (&["unable to connect"], UNREACHED),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_of_zenoh_have_a_remedy() {
        for (words, finding, remedy) in [
            ("invalid peer certificate: certificate expired: verification time 7", "has expired", "renew"),
            ("invalid peer certificate: Expected NotValidYet", "not valid yet", "clock"),
            ("invalid peer certificate: UnknownIssuer", "do not fit", "root_ca_certificate"),
            (
                "Received a close message (reason GENERIC) in response to an OpenSyn on: TransportLinkUnicast",
                "the user or the password is refused",
                "dictionary_file",
            ),
            (
                "Received a close message (reason 0) in response to an InitSyn on: tcp/127.0.0.1:1",
                "wants a user",
                "usrpwd/user",
            ),
            ("UsrPwd extension - Recv OpenSyn. Invalid password.", "somebody was refused", "dictionary_file"),
            ("Unable to connect to tcp/r:1! Connection refused (os error 111)", "no router", "firewall"),
        ] {
            let known = Diagnosis::of(words).unwrap_or_else(|| panic!("{words}"));
            assert!(known.finding.contains(finding) && known.remedy.contains(remedy), "{words}: {known:?}");
        }
        assert_eq!(Diagnosis::of("New moon"), None);
    }
}
