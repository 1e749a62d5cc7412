//! What gateways are called here: by their number, or by the name that the user gives one.

use schema::{Failure, Kind, check_sensor};

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
                let hint = "NAME=HUB, for example --name robot1=5f3a12bc00d1e2f3; `scanhub listen --stats` shows the hubs";
                Failure::new(Kind::Configuration, format!("--name {text}: {what}"), hint)
            };
            let (name, hub) = text.split_once('=').ok_or_else(|| wrong("no hub is named"))?;
            check_sensor(name).map_err(|failure| {
                let what = format!("--name {text}: {name:?} cannot be a hub's name here");
                Failure::new(failure.kind, what, format!("{HUB_NAMES}, for example robot1"))
            })?;
            let is_hex = hub.len() == 16 && hub.bytes().all(|byte| byte.is_ascii_hexdigit());
            let hub = u64::from_str_radix(hub, 16).ok().filter(|_| is_hex);
            let hub = hub.ok_or_else(|| wrong("a hub is 16 hex digits"))?;
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

/// What a hub may be called: its sensors are `HUB.SENSOR`, and each half has the same form; `robot` stands for all.
const HUB_NAMES: &str = "1 to 24 of a-z, 0-9, _ and -, but not robot";

#[cfg(test)]
mod tests {
    use super::*;

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
