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
        Defect::Unannounced => &["remote_liveness"],
    }
}

#[test]
fn every_planted_defect_is_found() {
    let mut missed = Vec::new();
    for defect in Defect::ALL {
        let finds = |seed: &u64| {
            let outcome = run_with(&Plan::of_seed(*seed, 40), Detail::Nothing, Some(defect));
            outcome.violations.iter().any(|violation| judge(defect).contains(&violation.judge))
        };
        match (0..200).find(finds) {
            Some(seed) => println!("{defect:?} is found by {:?} with seed {seed}", judge(defect)),
            None => missed.push(defect),
        }
    }
    assert_eq!(missed, []);
}
