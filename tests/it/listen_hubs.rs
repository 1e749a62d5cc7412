//! `scanhub listen --hub`, which receives only the named hubs among many others. The tests also check its message about
//! a gateway on its own machine, and statistics on request.

use crate::testkit::{INT, Robot, TestEnv, TestGateway, USR1, in_a_network, is_class, number};
use scanhub_schema::{Topic, Verdict, Zones};
use serde_json::json;

const HUB_ID: u64 = 0x5f3a_12bc_00d1_e2f3;

fn zones(verdict: Verdict) -> Zones {
    Zones { verdict: verdict as u8, ..Zones::unknown() }
}

/// Sends samples from more gateways than the listener's table has room for.
fn crowd() {
    for hub in 0..70 {
        let mut sender = TestGateway::new(hub, 7, 0, "other");
        sender.announce(&[Topic::Zones]);
        sender.send(Topic::Zones, &zones(Verdict::Stop));
    }
}

#[test]
fn receives_selected_hubs_in_a_crowd() {
    in_a_network("listen_hubs::receives_selected_hubs_in_a_crowd", || {
        let env = TestEnv::new();
        let name = "--name=robot1=5f3a12bc00d1e2f3";
        let words = ["listen", "--json", "--topic=zones", name, "--hub=robot1", "--hub=00000000000000ab"];
        let mut program = env.start(&words).ready();
        crowd();
        let senders = [HUB_ID, 0xab].map(|hub| {
            let mut sender = TestGateway::new(hub, 7, 0, "front");
            sender.announce(&[Topic::Zones]);
            sender.send_bytes(Topic::Zones, b"short");
            sender.send(Topic::Zones, &zones(Verdict::Clear));
            sender
        });
        program.await_lines(2, "zones", is_class("zones"));
        drop(senders);
        let outcome = program.end(INT);
        assert!(outcome.of_class("zones").iter().all(|line| line["verdict"] == "clear"), "{outcome}");
        let rows = outcome.of_class("lan");
        let hubs: Vec<_> = rows.iter().map(|line| line["hub"].as_str().unwrap_or_default()).collect();
        let (other, robot1) = ("00000000000000ab", "5f3a12bc00d1e2f3");
        assert_eq!(hubs, [other, other, robot1, robot1], "{outcome}");
        let refused = &outcome.of_class("lan_refused")[0];
        assert_eq!((&refused["capacity"], &refused["short"]), (&json!(0), &json!(2)), "{outcome}");
    });
}

#[test]
fn unselected_hubs_are_not_published() {
    in_a_network("listen_hubs::unselected_hubs_are_not_published", || {
        let env = TestEnv::new();
        let words = ["listen", "--json", "--publish", "--hub=5f3a12bc00d1e2f3"];
        let mut program = env.start(&words).ready();
        crowd();
        let line =
            TestGateway::new(HUB_ID, 7, 0, "front").wait_until_published(&mut program, &[Topic::Zones]);
        assert_eq!((&line["sensor"], &line["here"]), (&json!("5f3a12bc00d1e2f3.front"), &json!(true)));
        let outcome = program.end(INT);
        assert_eq!(outcome.of_class("notice").len(), 1, "{outcome}");
        assert_eq!(outcome.of_class("lan_published")[0]["sensors"], json!(["5f3a12bc00d1e2f3.front"]));
    });
}

#[test]
fn remote_gateway_is_not_marked_as_local() {
    in_a_network("listen_hubs::remote_gateway_is_not_marked_as_local", || {
        let robot = Robot::new(&["front"]);
        let env = TestEnv::new();
        let mut listener = env.start(&["listen", "--json", "--publish"]).ready();
        let gateway = robot.gateway::<&str>(&[]);
        let line = listener.await_line("a sensor", |line| line["kind"] == "published");
        assert_eq!(line["here"], json!(null), "{line}");
        drop(gateway);
        assert_eq!(listener.end(INT).exit_code, Some(0));
    });
}

#[test]
fn sigusr1_prints_statistics_of_the_listener() {
    in_a_network("listen_hubs::sigusr1_prints_statistics_of_the_listener", || {
        let env = TestEnv::new();
        let mut program = env.start(&["listen", "--json"]).ready();
        let mut sender = TestGateway::new(HUB_ID, 7, 0, "front");
        for received in 1..=2 {
            sender.send(Topic::Zones, &zones(Verdict::Clear));
            program.await_line("zones", is_class("zones"));
            program.signal(USR1);
            let line = program.await_line("the statistics", is_class("lan"));
            assert_eq!((number(&line, "received"), &line["topic"]), (received, &json!("zones")));
        }
        let outcome = program.end(INT);
        assert_eq!((outcome.exit_code, outcome.of_class("lan").len()), (Some(0), 3), "{outcome}");
    });
}
