//! The judges are shown to bite: each of some defects that are built into the models around the hub is found within 200 seeds,
//! by the judge whose business it is.

use world::{Defect, Detail, Plan, run_with};

fn judge(defect: Defect) -> &'static [&'static str] {
    match defect {
        Defect::LostWake | Defect::OneRing | Defect::Delayed => &["prompt"],
        Defect::LostByte => &["bytes"],
        Defect::FlippedBit | Defect::UnsentTelegram => &["nothing_lost"],
        Defect::SurvivingVerdict => &["verdict"],
        Defect::UnreleasedHandle | Defect::LeakedLoan => &["resources"],
        Defect::SentTwice | Defect::Reordered => &["accounts"],
        Defect::Renumbered => &["numbers"],
        Defect::EepromWrite => &["eeprom"],
        Defect::SwallowedHangUp => &["liveness"],
        Defect::MergedTurn | Defect::OtherBeams | Defect::StampedOnArrival | Defect::UnmarkedTurn => {
            &["turns"]
        }
        Defect::UncountedLoss => &["lost_on_line"],
        Defect::RemoteAltered | Defect::RemoteHalf => &["remote_nothing_invented"],
        Defect::RemoteCountedTwice => &["remote_accounts"],
        Defect::RemoteStampedLate => &["remote_numbers"],
        Defect::RemoteSurvivingVerdict => &["remote_verdict"],
        Defect::RemoteUnchecked => &["remote_keys"],
        Defect::Unannounced | Defect::RouterGivenUp => &["remote_liveness"],
        Defect::RouterUntold => &["remote_bridge"],
        Defect::WrongChecksum => &["nothing_invented"],
        Defect::UnmarkedNeighbour => &["nothing_lost"],
        Defect::DeafScanner | Defect::UnturnedHead => &["liveness"],
        Defect::WrongPlaces => &["turns"],
        Defect::KeptWarning => &["early"],
    }
}

/// Defects of turns and of requests, in worlds with nothing but this scanner, whose head turns.
const OF_HEADS: [(Defect, &str); 11] = [
    (Defect::MergedTurn, "a1:express"),
    (Defect::UnmarkedTurn, "s1"),
    (Defect::StampedOnArrival, "a1"),
    (Defect::UncountedLoss, "c1"),
    (Defect::WrongChecksum, "a1"),
    (Defect::UnmarkedNeighbour, "s1"),
    (Defect::DeafScanner, "a1::streaming"),
    (Defect::UnturnedHead, "a2m8"),
    (Defect::WrongPlaces, "c1"),
    (Defect::KeptWarning, "ld19"),
    (Defect::KeptWarning, "s1"),
];

#[test]
fn every_planted_defect_is_found() {
    let mut missed = Vec::new();
    let of_all = Defect::ALL.into_iter().map(|defect| (defect, None));
    for (defect, model) in of_all.chain(OF_HEADS.map(|(defect, model)| (defect, Some(model.to_owned())))) {
        let finds = |seed: &u64| {
            let plan = Plan { model: model.clone(), ..Plan::of_seed(*seed, 40) };
            let outcome = run_with(&plan, Detail::Nothing, Some(defect));
            outcome.violations.iter().any(|violation| judge(defect).contains(&violation.judge))
        };
        match (0..200).find(finds) {
            Some(seed) => println!("{defect:?} is found by {:?} with seed {seed} {model:?}", judge(defect)),
            None => missed.push((defect, model)),
        }
    }
    assert_eq!(missed, []);
}

/// What happens between the machines, and a defect that shows when nothing else happens.
const BETWEEN_MACHINES: [(&str, Defect); 3] = [
    ("partition", Defect::RemoteSurvivingVerdict),
    ("router_killed", Defect::RouterGivenUp),
    ("key_errors", Defect::RemoteUnchecked),
];

#[test]
fn what_happens_between_machines_alone_shows_its_defect() {
    for (name, defect) in BETWEEN_MACHINES {
        let finds = |seed: &u64, defect: Option<Defect>| {
            let mut plan = Plan::of_seed(*seed, 40);
            plan.actions.retain(|action| action.name() == name);
            let outcome = run_with(&plan, Detail::Nothing, defect);
            !plan.actions.is_empty()
                && outcome.violations.iter().any(|found| match defect {
                    Some(defect) => judge(defect).contains(&found.judge),
                    None => true,
                })
        };
        let found = (0..200).find(|seed| finds(seed, Some(defect)));
        let seed = found.unwrap_or_else(|| panic!("{name}: nobody finds {defect:?}"));
        println!("{name}: {defect:?} is found by {:?} with seed {seed}", judge(defect));
        assert!(!finds(&seed, None), "{name}, seed {seed}: something is found without it");
    }
}
