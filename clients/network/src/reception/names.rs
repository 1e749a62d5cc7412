//! What gateways are called here: by their number, or by the name that the user gives one; and which of them are wanted.

use scanhub_schema::datagram::Datagram;
use scanhub_schema::{Failure, Kind, check_sensor};

/// Names that the user gave.
#[derive(Default)]
pub(super) struct Names(Vec<(String, u64)>);

impl Names {
    /// From `NAME=HUB`, HUB being 16 hex digits as in all output.
    ///
    /// [`Kind::Configuration`] if a name or a number is not possible, or if one is given twice.
    pub(super) fn parse(given: &[String]) -> Result<Names, Failure> {
        let mut names: Vec<(String, u64)> = Vec::new();
        for text in given {
            let wrong = |what: &str| {
                let hint = "NAME=HUB, for example --name robot1=5f3a12bc00d1e2f3; a gateway or bridge prints its own at its start";
                Failure::new(Kind::Configuration, format!("--name {text}: {what}"), hint)
            };
            let (name, hub) = text.split_once('=').ok_or_else(|| wrong("no hub is named"))?;
            check_sensor(name).map_err(|failure| {
                let what = format!("--name {text}: {name:?} cannot be a hub's name here");
                Failure::new(failure.kind, what, format!("{HUB_NAMES}, for example robot1"))
            })?;
            let hub = number(hub).ok_or_else(|| wrong("a hub is 16 hex digits"))?;
            if names.iter().any(|(other, known)| other == name || *known == hub) {
                return Err(wrong("named twice"));
            }
            names.push((name.to_owned(), hub));
        }
        Ok(Names(names))
    }

    /// What `hub` is called.
    pub(super) fn of(&self, hub: u64) -> String {
        let given = self.0.iter().find(|(_, known)| *known == hub);
        given.map_or_else(|| format!("{hub:016x}"), |(name, _)| name.clone())
    }
}

/// The hub with these 16 hex digits.
fn number(text: &str) -> Option<u64> {
    let is_hex = text.len() == 16 && text.bytes().all(|byte| byte.is_ascii_hexdigit());
    u64::from_str_radix(text, 16).ok().filter(|_| is_hex)
}

/// The hubs that are wanted; none: all.
pub(super) struct Hubs(Vec<u64>);

impl Hubs {
    /// From `given`: each a hub's name in `names`, or its 16 hex digits.
    ///
    /// [`Kind::Configuration`] if one is neither.
    pub(super) fn parse(given: &[String], names: &Names) -> Result<Hubs, Failure> {
        let hub = |text: &String| {
            let named = names.0.iter().find(|(name, _)| name == text).map(|(_, hub)| *hub);
            named.or_else(|| number(text)).ok_or_else(|| {
                let what = format!("--hub {text}: neither 16 hex digits nor a name that --name gives");
                let hint = format!(
                    "for example --hub 5f3a12bc00d1e2f3, or --name {text}=5f3a12bc00d1e2f3 besides; \
                     a gateway or bridge prints its own at its start"
                );
                Failure::new(Kind::Configuration, what, hint)
            })
        };
        given.iter().map(hub).collect::<Result<_, _>>().map(Hubs)
    }

    /// These bytes are not a whole datagram of another hub.
    pub(super) fn want(&self, bytes: &[u8]) -> bool {
        let is_wanted = |datagram: Datagram<'_>| self.0.contains(&datagram.head.hub);
        self.0.is_empty() || Datagram::read(bytes).map_or(true, is_wanted)
    }
}

/// What a hub may be called: its sensors are `HUB.SENSOR`, and each half has the same form; `robot` stands for all.
const HUB_NAMES: &str = "1 to 24 of a-z, 0-9, _ and -, but not robot";

#[cfg(test)]
mod tests {
    use super::*;

    use scanhub_schema::datagram::{HEAD, Head};

    #[test]
    fn hubs_are_wanted_by_number_and_by_name() {
        let names = Names::parse(&["robot1=00000000000000ab".into()]).unwrap();
        let parse =
            |texts: &[&str]| Hubs::parse(&texts.iter().map(|&text| text.into()).collect::<Vec<_>>(), &names);
        let wanted = |texts: &[&str], hub| {
            let mut buffer = [0; HEAD];
            let bytes = Head { hub, ..Head::default() }.seal(&mut buffer, 0).unwrap();
            parse(texts).unwrap().want(bytes)
        };
        let both = ["robot1", "00000000000000AC"];
        assert_eq!([0xab, 0xac, 0xad].map(|hub| wanted(&both, hub)), [true, true, false]);
        assert!(wanted(&[], 0xad) && parse(&both).unwrap().want(b"what is broken is to be counted"));
        for bad in ["robot2", "ab", "", "+0000000000000ab"] {
            let failure = parse(&[bad]).map(drop).unwrap_err();
            assert!(failure.kind == Kind::Configuration && failure.hint.contains("--name"), "{failure}");
        }
    }

    #[test]
    fn names_are_given_once_and_have_a_form() {
        let parse = |texts: &[&str]| Names::parse(&texts.iter().map(|&text| text.into()).collect::<Vec<_>>());
        let names = parse(&["robot1=00000000000000ab"]).unwrap();
        assert_eq!((names.of(0xab), names.of(1)), ("robot1".into(), "0000000000000001".into()));
        let failure = parse(&["Robot=00000000000000ab"]).map(drop).unwrap_err();
        assert!(failure.message.contains("hub's name") && failure.hint.contains("robot1"), "{failure}");
        for bad in [
            &["robot1"][..],
            &["Robot=00000000000000ab"],
            &["a=ab"],
            &["a=+0000000000000ab"],
            &["a=00000000000000ab", "a=00000000000000ac"],
            &["a=00000000000000ab", "b=00000000000000ab"],
        ] {
            assert_eq!(
                parse(bad).map(|_| ()).map_err(|failure| failure.kind),
                Err(Kind::Configuration),
                "{bad:?}"
            );
        }
    }
}
