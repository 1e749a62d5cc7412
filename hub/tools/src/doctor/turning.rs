//! A scanner whose head turns at the other end: whether it is what the configuration says, and how well it is heard. Judges
//! what it says; refuses to listen and to ask.

use config::{Link, Scanner};
use scanhub_drivers::line::family::Condition;
use scanhub_drivers::scanner::Introduction;

use super::finding::Finding;
use crate::listen::{LINE_REMEDY, Overheard};

/// What follows from what was `heard`.
pub(crate) fn examine(heard: &Overheard, link: Option<&Link>) -> Vec<Finding> {
    let text = format!("{heard}, family {}", heard.family.name());
    let mut findings = vec![match &heard.said {
        Some(said) => Finding::ok("sensor", format!("{text}, {}", said.identity)),
        None => Finding::ok("sensor", text),
    }];
    findings.push(loss(heard));
    let is_reported = heard.said.is_some();
    if heard.is_unreliable() && !is_reported {
        let why = "not judged: the line damages most bytes";
        findings.extend(["settings", "health"].map(|name| Finding::skipped(name, why)));
        return findings;
    }
    findings.extend([
        settings(heard, link),
        heard.said.as_ref().map_or_else(|| health(heard), |said| well(said, heard)),
    ]);
    findings
}

/// Returns the health that it reports, and whether it measures.
fn well(said: &Introduction, heard: &Overheard) -> Finding {
    const NAME: &str = "health";
    let remedy = "see whether its head turns freely; power it off and on again; if it stays so, a repair";
    match said.condition {
        Condition::Good | Condition::Warning | Condition::Unknown if heard.packets == 0 => {
            let trouble = heard.trouble.as_deref().unwrap_or("it does not measure");
            Finding::failed(NAME, trouble, remedy)
        }
        Condition::Unknown => Finding::warning(NAME, "it does not say how it is", remedy),
        Condition::Good => Finding::ok(NAME, said.health.clone()),
        Condition::Warning => Finding::warning(NAME, said.health.clone(), remedy),
        Condition::Error => Finding::failed(NAME, said.health.clone(), remedy),
    }
}

/// Whether it is the configured model, and whether there is room for its points.
fn settings(heard: &Overheard, link: Option<&Link>) -> Finding {
    const NAME: &str = "settings";
    let text = match (&heard.said, heard.model) {
        (None, _) => {
            format!("{:.0} points a second, {:.0} in a turn", heard.points_per_second, heard.points())
        }
        (Some(_), Some(model)) => format!("up to {} points in a turn", model.beams),
        (Some(_), None) => "a model that is not known here".to_owned(),
    };
    let Some((model, link)) = heard.model.zip(link) else { return Finding::ok(NAME, text) };
    let Scanner::Turning(turning) = link.scanner else { return Finding::ok(NAME, text) };
    let (set, name) = (turning.model, &link.name);
    if set != turning.features.auto && (set.baud, set.beams) != (model.baud, model.beams) {
        return Finding::warning(
            NAME,
            format!(
                "model {} is configured, but the scanner is a {} or compatible with it",
                set.name, model.name
            ),
            format!("--set link.{name}.model={}, or plug in the other scanner", model.name),
        );
    }
    if turning.is_auto() && link.beams() < model.beams {
        return Finding::warning(
            NAME,
            format!("{text}, and there is room for {} beams", link.beams()),
            format!("--set link.{name}.model={}, or link.{name}.beams", model.name),
        );
    }
    Finding::ok(NAME, text)
}

/// Whether its head turns as it should.
fn health(heard: &Overheard) -> Finding {
    const NAME: &str = "health";
    if heard.turns_per_second > 0.0 {
        return Finding::ok(NAME, format!("{:.1} turns a second", heard.turns_per_second));
    }
    let what = heard.trouble.as_deref().unwrap_or("packets come, but no turn was whole");
    let (what, _) = what.split_once(": ").unwrap_or((what, ""));
    Finding::failed(
        NAME,
        what,
        "see whether its head turns freely, and whether it gets 5 V; power it off and on again",
    )
}

/// Whether its packets arrive whole.
fn loss(heard: &Overheard) -> Finding {
    const NAME: &str = "line-loss";
    let (damaged, lost) = (100.0 * heard.damaged(), heard.account.lost);
    if heard.packets == 0 {
        return Finding::skipped(NAME, "it does not measure");
    }
    let packets = match lost {
        // Those that are damaged are missing, too, but too little arrives to count them.
        0 if heard.is_unreliable() => "how many packets are lost is not known".to_owned(),
        lost => format!("{lost} of {} packets lost", heard.account.due),
    };
    let text = format!("{damaged:.1} % of the bytes damaged, {packets}");
    if heard.is_unreliable() {
        return Finding::failed(NAME, text, LINE_REMEDY);
    }
    if lost * WELL > heard.account.due || heard.line_trouble().is_some() {
        return Finding::warning(NAME, text, LINE_REMEDY);
    }
    Finding::ok(NAME, text)
}

/// A line that takes away more than one of so many has something that is to be looked for.
const WELL: u64 = 100;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::finding::State;
    use scanhub_drivers::line::Account;
    use schema::Family;

    fn heard() -> Overheard {
        let (family, features) = crate::listen::turning()[0];
        Overheard {
            family,
            model: Some(features.models[1]),
            rate: 230_400,
            account: Account { in_telegrams: 9_400, due: 200, ..Account::default() },
            said: None,
            packets: 200,
            points_per_second: 4_500.0,
            turns_per_second: 10.0,
            trouble: None,
        }
    }

    fn link(set: &[&str]) -> Link {
        let sources = config::Sources {
            files: Vec::new(),
            set: set.iter().map(|flag| format!("link.side.{flag}")).collect(),
            links: vec!["side=/dev/ttyUSB0".to_owned()],
        };
        config::Config::load(&sources).expect("it is valid").links.remove(0)
    }

    #[test]
    fn what_it_says_is_judged() {
        let said = |heard: &Overheard| {
            let findings = examine(heard, None);
            findings.iter().map(|finding| (finding.name, finding.state)).collect::<Vec<_>>()
        };
        let names = ["sensor", "line-loss", "settings", "health"];
        assert_eq!(said(&heard()), names.map(|name| (name, State::Ok)));
        let still = Overheard { turns_per_second: 0.0, ..heard() };
        assert_eq!(said(&still)[3], ("health", State::Failed));
        let lossy = Overheard { account: Account { lost: 3, ..heard().account }, ..heard() };
        assert_eq!(said(&lossy)[1], ("line-loss", State::Warning));
        let damaged = Overheard { account: Account { damaged: 100, ..heard().account }, ..heard() };
        assert_eq!(said(&damaged)[1], ("line-loss", State::Warning));
        let text = examine(&damaged, None)[1].to_string();
        assert!(text.contains(", 0 of "), "{text}");
        // Where most bytes are damaged, a head that seems to stand still may turn.
        let account = Account { damaged: 40_000, ..heard().account };
        let unreliable = [
            ("sensor", State::Ok),
            ("line-loss", State::Failed),
            ("settings", State::Skipped),
            ("health", State::Skipped),
        ];
        let most = Overheard { account, ..still };
        assert_eq!(said(&most), unreliable);
        let text = examine(&most, None)[1].to_string();
        assert!(text.contains("how many packets are lost is not known"), "{text}");
    }

    #[test]
    fn what_it_says_of_its_health_is_judged() {
        let said = |condition| {
            let said = Introduction { identity: "firmware 1.29".into(), health: "so".into(), condition };
            let findings = examine(&Overheard { said: Some(said), ..heard() }, None);
            findings.iter().map(|finding| (finding.name, finding.state)).next_back()
        };
        for (condition, state) in [
            (Condition::Good, State::Ok),
            (Condition::Warning, State::Warning),
            (Condition::Unknown, State::Warning),
            (Condition::Error, State::Failed),
        ] {
            assert_eq!(said(condition), Some(("health", state)));
        }
    }

    #[test]
    fn what_the_configuration_says_otherwise_is_told() {
        let family = format!("family={}", Family::name(heard().family));
        let judged = |heard: &Overheard, set: &[&str]| {
            settings(heard, Some(&link(&[&[family.as_str()], set].concat())))
        };
        let models = crate::listen::turning()[0].1.models;
        // What cannot be told apart is the same.
        let (like, other) = (format!("model={}", models[0].name), format!("model={}", models[3].name));
        assert_eq!(judged(&heard(), &[&like]).state, State::Ok);
        let wrong = judged(&heard(), &[&other]);
        assert!(wrong.state == State::Warning && wrong.finding.contains(models[3].name), "{wrong}");
        assert!(wrong.remedy.contains("link.side.model="), "{wrong}");
        let large = Overheard { model: Some(models[3]), ..heard() };
        assert_eq!(judged(&large, &[&other]).state, State::Ok);
        let room = judged(&large, &[]);
        assert!(room.state == State::Warning && room.finding.contains("room for 720"), "{room}");
    }
}
