//! `scanhub listen` with more gateways and sensors than its tables have room for, such as when a sender invents them.
//! The listener does not evict sensors that deliver. If a genuine sensor starts later, the listener receives it at
//! once. The log reports the shortage, but not with a line for each sender.

use std::time::Duration;

use crate::testkit::{
    INT, Outcome, Program, TestEnv, TestGateway, in_a_network, is_class, number, wait_at_least, wait_until,
};
use scanhub_schema::{State, Status, Topic, Verdict, Zones};
use serde_json::{Value, json};

const HUB_ID: u64 = 0x5f3a_12bc_00d1_e2f3;
const NAME_FLAG: &str = "--name=robot1=5f3a12bc00d1e2f3";

fn zones(verdict: Verdict) -> Zones {
    Zones { verdict: verdict as u8, ..Zones::unknown() }
}

/// Announces the sensor of `sender`, and sends samples of it.
fn deliver_samples(sender: &mut TestGateway) {
    sender.announce(&[Topic::Zones, Topic::Status]);
    sender.send(Topic::Zones, &zones(Verdict::Clear));
}

/// Time after which the listener accepts a gateway or sensor as proven, if it has delivered samples for all of this
/// time.
const PROOF_TIME: Duration = Duration::from_secs(1);

/// Delivers samples until the sender counts as proven. `wait_until_received` waits until the listener has received the
/// sample that was sent last.
fn deliver_for_proof_time(sender: &mut TestGateway, mut wait_until_received: impl FnMut(&mut TestGateway)) {
    deliver_samples(sender);
    wait_until_received(sender);
    wait_at_least(PROOF_TIME);
    deliver_samples(sender);
    wait_until_received(sender);
}

/// Sends `verdict` repeatedly until `echo` prints it. If `echo` reads a verdict too late, it prints `unknown` instead,
/// and the verdict must be sent again.
fn await_verdict(sender: &mut TestGateway, echo: &mut Program, verdict: Verdict) {
    let mut printed = Value::Null;
    while printed["verdict"] != verdict.name() {
        sender.send(Topic::Zones, &zones(verdict));
        printed = echo.await_line("a sample", |line| is_class("zones")(line) && line["topic_seq"].is_u64());
    }
}

/// Returns how often the listener has reported that its tables had no room.
fn count_capacity_notices(outcome: &Outcome) -> usize {
    let reports_capacity =
        |line: &&Value| line["message"].as_str().is_some_and(|text| text.contains("--hub"));
    outcome.of_class("notice").iter().filter(reports_capacity).count()
}

fn zones_row(outcome: &Outcome, hub: &str) -> Value {
    let row = outcome.of_class("lan").into_iter().find(|line| line["hub"] == hub && line["topic"] == "zones");
    row.unwrap_or_else(|| panic!("no statistics of {hub}: {outcome}"))
}

#[test]
fn receives_real_gateway_at_once_after_64_invented() {
    in_a_network("listen_crowd::receives_real_gateway_at_once_after_64_invented", || {
        let env = TestEnv::new();
        for is_delivered in [false, true] {
            let mut program = env.start(&["listen", "--json", "--topic=zones", NAME_FLAG]).ready();
            for hub in 0..64 {
                let mut sender = TestGateway::new(hub, 7, 0, "other");
                sender.announce(&[Topic::Zones]);
                if is_delivered {
                    sender.send(Topic::Zones, &zones(Verdict::Stop));
                }
            }
            let mut sender = TestGateway::new(HUB_ID, 7, 0, "front");
            deliver_samples(&mut sender);
            let hub = json!("5f3a12bc00d1e2f3");
            program.await_line("sample of the genuine sensor", |line| {
                line["hub"] == hub && line["class"] == "zones"
            });
            // The listener may print the report of the shortage before or after the line of the genuine sensor.
            let is_problem = |line: &Value| line["kind"] == "problem";
            if !program.has_printed(is_problem) {
                program.await_line("report of the shortage", is_problem);
            }
            // The first announcement does not evict a sensor that has just delivered, so it may be refused. Another
            // announcement is accepted.
            deliver_samples(&mut sender);
            program.await_line("a line with the name of the sensor", |line| {
                line["sensor"] == "front" && line["class"] == "zones"
            });
            let outcome = program.end(INT);
            let capacity = number(&outcome.of_class("lan_refused")[0], "capacity");
            assert_eq!(
                (count_capacity_notices(&outcome), capacity),
                (1, u64::from(is_delivered)),
                "{outcome}"
            );
            let sums = &outcome.of_class("lan_evicted")[0];
            assert_eq!((&sums["runs"], &sums["evicted_active"]), (&json!(1), &json!(1)), "{outcome}");
        }
    });
}

#[test]
fn invented_gateways_do_not_evict_a_delivering_one() {
    in_a_network("listen_crowd::invented_gateways_do_not_evict_a_delivering_one", || {
        let env = TestEnv::new();
        let mut program = env.start(&["listen", "--json", "--topic=zones", NAME_FLAG]).ready();
        let mut sender = TestGateway::new(HUB_ID, 7, 0, "front");
        deliver_for_proof_time(&mut sender, |_| {
            drop(program.await_line("sample of the sensor", is_class("zones")))
        });
        const ROUNDS: u64 = 100;
        let mut invented = TestGateway::new(0, 7, 0, "other");
        for round in 0..ROUNDS {
            for n in 0..40 {
                invented.hub = 40 * round + n;
                invented.announce(&[Topic::Zones]);
                if n % 2 == 0 {
                    invented.send(Topic::Zones, &zones(Verdict::Clear));
                }
            }
            let topic_seq = sender.next[usize::from(Topic::Zones.number())];
            sender.send(Topic::Zones, &zones(Verdict::Stop));
            // Wait for this sample, so that the datagrams of the flood do not overflow the listener's receive buffer.
            program.await_line("sample of the genuine sensor", |line| {
                line["verdict"] == "stop" && line["topic_seq"] == json!(topic_seq)
            });
        }
        let outcome = program.end(INT);
        let row = zones_row(&outcome, "5f3a12bc00d1e2f3");
        assert_eq!((number(&row, "received"), number(&row, "lost")), (ROUNDS + 2, 0), "{row}");
        assert!(number(&outcome.of_class("lan_evicted")[0], "evicted_active") > 1000, "{outcome}");
        assert_eq!(count_capacity_notices(&outcome), 1, "4000 gateways must cause only one report");
    });
}

fn publisher(env: &TestEnv) -> Program {
    env.start(&["listen", "--json", "--publish", NAME_FLAG]).ready()
}

/// Creates a genuine sensor, and waits until the listener publishes it. The listener publishes the sensor as soon as
/// its gateway has delivered for a second. The sensor itself is not proven by then, because samples before the
/// publication do not count for the sensor.
fn published_sender(program: &mut Program) -> TestGateway {
    let mut sender = TestGateway::new(HUB_ID, 7, 0, "front");
    wait_until("the sensor is published", || {
        deliver_samples(&mut sender);
        program.prints(|line| line["kind"] == "published" && line["sensor"] == "robot1.front")
    });
    sender.send(Topic::Status, &Status { state: State::Streaming as u8, ..Status::default() });
    sender
}

#[test]
fn publishes_real_sensor_at_once_after_16_invented() {
    in_a_network("listen_crowd::publishes_real_sensor_at_once_after_16_invented", || {
        let env = TestEnv::new();
        for is_delivered in [false, true] {
            let mut program = publisher(&env);
            for n in 0..16 {
                let mut sender = TestGateway::new(0xab, 7, n, &format!("s{n}"));
                sender.wait_until_published(&mut program, &[Topic::Zones]);
                if is_delivered {
                    sender.send(Topic::Zones, &zones(Verdict::Stop));
                }
            }
            let mut sender = published_sender(&mut program);
            await_verdict(&mut sender, &mut env.echo(&["robot1.front/zones"]), Verdict::Slow);
            let outcome = program.end(INT);
            assert_eq!(count_capacity_notices(&outcome), 1, "{outcome}");
            let sensors = &outcome.of_class("lan_published")[0]["sensors"];
            assert_eq!(sensors.as_array().map(Vec::len), Some(16), "{outcome}");
            assert!(!sensors.to_string().contains("ab.s0\""), "the oldest sensor must be evicted: {sensors}");
        }
    });
}

#[test]
fn new_sensors_do_not_evict_a_delivering_one() {
    in_a_network("listen_crowd::new_sensors_do_not_evict_a_delivering_one", || {
        let env = TestEnv::new();
        let mut program = publisher(&env);
        let mut sender = published_sender(&mut program);
        let mut echo = env.echo(&["robot1.front/zones"]);
        deliver_for_proof_time(&mut sender, |sender| await_verdict(sender, &mut echo, Verdict::Clear));
        let mut invented = TestGateway::new(0xab, 7, 0, "s");
        invented.wait_until_published(&mut program, &[Topic::Zones]);
        for round in 0..50_u8 {
            for n in 0..4 {
                (invented.sensor, invented.name) = (4 * round + n, format!("s{round}-{n}"));
                invented.announce(&[Topic::Zones]);
                invented.send(Topic::Zones, &zones(Verdict::Clear));
            }
            // Alternate the verdict, so that a line with an earlier sample is not taken for the new sample.
            await_verdict(&mut sender, &mut echo, if round % 2 == 0 { Verdict::Stop } else { Verdict::Slow });
        }
        let echoed = echo.end(INT);
        assert_eq!(echoed.of_class("summary")[0]["missed"], 0, "{echoed}");
        let outcome = program.end(INT);
        let line = &outcome.of_class("lan_published")[0];
        assert!(line["sensors"].to_string().contains("robot1.front"), "{line}");
        assert!(number(line, "capacity") > 0, "the listener must refuse some of the sensors: {line}");
        assert_eq!(count_capacity_notices(&outcome), 1, "{outcome}");
    });
}

#[test]
fn subscriber_survives_eviction_of_its_sensor() {
    in_a_network("listen_crowd::subscriber_survives_eviction_of_its_sensor", || {
        let env = TestEnv::new();
        let mut program = publisher(&env);
        let mut sender = published_sender(&mut program);
        let mut echo = env.echo(&["robot1.front/zones"]);
        let mut others: Vec<_> = (0..16).map(|n| TestGateway::new(0xab, 7, n, &format!("s{n}"))).collect();
        others[0].wait_until_published(&mut program, &[Topic::Zones, Topic::Status]);
        others.iter_mut().for_each(deliver_samples);
        program.await_line("the last sample", |line| line["sensor"] == "00000000000000ab.s15");
        echo.await_line("unknown zones", |line| line["verdict"] == "unknown");
        deliver_samples(&mut sender);
        program.await_line("sample of the sensor again", |line| line["sensor"] == "robot1.front");
        await_verdict(&mut sender, &mut echo, Verdict::Stop);
        drop((echo.end(INT), program.end(INT)));
        assert!(env.leftover_files().is_empty(), "{:?}", env.leftover_files());
    });
}
