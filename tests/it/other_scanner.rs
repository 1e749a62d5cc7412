//! A hub at a scanner of another family than its link has: bytes arrive, and none of them make sense.

use serde_json::Value;

use crate::testkit::{TERM, TestEnv};

#[test]
fn bytes_of_another_scanner_are_reported_with_their_rate() {
    const LD19: &[&str] = &["--family=ld", "--model=ld19"];
    const LMS: &[&str] = &["--baud=500000", "--state=streaming"];
    for (simulated, family, missing) in
        [(LD19, "lms", "LMS replies"), (LD19, "rplidar", "RPLIDAR replies"), (LMS, "ld", "LDROBOT packets")]
    {
        let env = TestEnv::new();
        let _simulator = env.simulator(&["front"], &[&["--seed=43"], simulated].concat());
        let hub = env.hub(&[format!("{},family={family}", env.link("front"))]);
        let says = format!(
            " bytes/s arrive, but no {missing}; is it another scanner? Try: scanhub probe {}",
            env.word("front")
        );
        let error = |info: &Value| info["last_error"].as_str().unwrap_or_default().to_owned();
        let info = env.await_info("front", |info| error(info).contains(" bytes/s arrive"));
        let error = error(&info);
        let rate = error.strip_suffix(&says).unwrap_or_else(|| panic!("{says}: {info}"));
        let rate: u64 = rate.replace(',', "").parse().unwrap_or_else(|_| panic!("{info}"));
        assert!((100..50_000).contains(&rate), "{info}");
        let outcome = hub.end(TERM);
        assert_eq!(outcome.code, Some(0), "{outcome}");
        for wrong in ["no answer", "power, cable"] {
            assert!(!outcome.errors.contains(wrong), "{outcome}");
        }
    }
}

#[test]
fn a_silent_line_may_have_another_scanner() {
    for (family, says) in [
        ("lms", "no answer at 9600, 19200, 38400 or 500000 baud"),
        ("rplidar", "no answer at 115200, 256000, 460800 and 1000000 baud"),
        ("ld", "no packets at 230400 and 921600 baud"),
    ] {
        let env = TestEnv::new();
        let _simulator = env.simulator(&["front"], &["--fault=mute=1"]);
        let _hub = env.hub(&[format!("{},family={family}", env.link("front"))]);
        let error = |info: &Value| info["last_error"].as_str().unwrap_or_default().to_owned();
        let info = env.await_info("front", |info| error(info).starts_with(says));
        let remedy = format!(" Another scanner? Try: scanhub probe {}", env.word("front"));
        assert!(error(&info).ends_with(&remedy), "{info}");
    }
}
