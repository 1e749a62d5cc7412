//! `scanhub simulate`, as somebody runs it: what its flags say is what is there to be found.

mod stage;

use stage::{Stage, TERM, number};

#[test]
fn a_sensor_with_a_past_tells_it_when_it_is_asked() {
    let stage = Stage::new();
    let flags = [
        "--permanent-baud=38400",
        "--state=installation",
        "--type=lms221",
        "--address=5",
        "--error=3:18",
        "--error=0x84:22",
        "--status=0x13",
        "--pollution=60",
        "--short-configuration",
    ];
    let simulator = stage.simulator(&["front"], &flags);
    let outcome = stage.run(&["probe", &stage.word("front"), "--json"]);
    assert_eq!(outcome.code, Some(0), "{outcome}");
    let [found] = &outcome.lines()[..] else { panic!("{outcome}") };
    assert_eq!((number(found, "baud"), number(found, "operating_mode")), (38_400, 0), "{found}");
    assert_eq!((&found["type"], number(found, "unit_mm")), (&"LMS221".into(), 10), "{found}");
    assert_eq!(found["permanent_rate"], true, "{found}");
    assert_eq!(found["errors"].as_array().map(Vec::len), Some(2), "{found}");
    assert_eq!(found["configuration"].as_str().map(str::len), Some(64), "{found}");
    assert_eq!(simulator.end(TERM).code, Some(0));
    assert_eq!(stage.simulated("front").1, 0);
}

#[test]
fn faults_are_named_in_the_truth() {
    let stage = Stage::new();
    let fault = "--fault=truncate=0.3,length=0.3";
    let simulator = stage.simulator(&["front"], &["--baud=500000", "--state=streaming", fault]);
    let hub = stage.hub(&[stage.link("front")]);
    stage.await_info("front", |info| info["state"] == "streaming");
    for name in ["truncated", "length", "unread"] {
        stage::until(name, || {
            let text = std::fs::read_to_string(stage.path("truth")).unwrap_or_default();
            text.contains(&format!(r#""fault":"{name}""#))
        });
    }
    assert_eq!(hub.end(TERM).code, Some(0));
    assert_eq!(simulator.end(TERM).code, Some(0));
}
