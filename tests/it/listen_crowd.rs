//! `scanhub listen` where more is sent than there is room for, as when somebody invents gateways and sensors: what is known
//! to deliver stays, a true one that comes later is heard at once, and the log says what happened without a line for each.

use std::time::Duration;

use crate::testkit::{
    INT, Outcome, Program, Sender, TestEnv, in_a_network, is_class, let_pass, number, until,
};
use scanhub_schema::{State, Status, Topic, Verdict, Zones};
use serde_json::{Value, json};

const HUB: u64 = 0x5f3a_12bc_00d1_e2f3;
const NAME: &str = "--name=robot1=5f3a12bc00d1e2f3";

fn zones(verdict: Verdict) -> Zones {
    Zones { verdict: verdict as u8, ..Zones::unknown() }
}

/// Announces a sensor and delivers a sample of it.
fn deliver(sender: &mut Sender) {
    sender.announce(&[Topic::Zones, Topic::Status]);
    sender.send(Topic::Zones, &zones(Verdict::Clear));
}

/// Whoever has delivered for so long, by the listener's clock, is known for it.
const KNOWN_AFTER: Duration = Duration::from_secs(1);

/// Delivers for as long as it takes to be known for it; `is_heard` waits until the next sample is.
fn prove(sender: &mut Sender, mut await_heard: impl FnMut(&mut Sender)) {
    deliver(sender);
    await_heard(sender);
    let_pass(KNOWN_AFTER);
    deliver(sender);
    await_heard(sender);
}

/// Sends `verdict` until `echo` prints it. A verdict that a client reads too late is printed as unknown.
fn await_verdict(sender: &mut Sender, echo: &mut Program, verdict: Verdict) {
    let mut said = Value::Null;
    while said["verdict"] != verdict.name() {
        sender.send(Topic::Zones, &zones(verdict));
        said = echo.await_line("a sample", |line| is_class("zones")(line) && line["topic_seq"].is_u64());
    }
}

/// How often it was told that there was no room.
fn told(outcome: &Outcome) -> usize {
    let is_told = |line: &&Value| line["message"].as_str().is_some_and(|text| text.contains("--hub"));
    outcome.of_class("notice").iter().filter(is_told).count()
}

fn zones_row(outcome: &Outcome, hub: &str) -> Value {
    let row = outcome.of_class("lan").into_iter().find(|line| line["hub"] == hub && line["topic"] == "zones");
    row.unwrap_or_else(|| panic!("no row of {hub}: {outcome}"))
}

#[test]
fn a_true_gateway_is_heard_at_once_after_64_invented_ones() {
    in_a_network("listen_crowd::a_true_gateway_is_heard_at_once_after_64_invented_ones", || {
        let env = TestEnv::new();
        for is_delivered in [false, true] {
            let mut program = env.start(&["listen", "--json", "--topic=zones", NAME]).ready();
            for hub in 0..64 {
                let mut sender = Sender::new(hub, 7, 0, "other");
                sender.announce(&[Topic::Zones]);
                if is_delivered {
                    sender.send(Topic::Zones, &zones(Verdict::Stop));
                }
            }
            let mut sender = Sender::new(HUB, 7, 0, "front");
            deliver(&mut sender);
            let hub = json!("5f3a12bc00d1e2f3");
            program.await_line("the true one", |line| line["hub"] == hub && line["class"] == "zones");
            // It may come before the true one is heard, or after.
            let is_told = |line: &Value| line["kind"] == "problem";
            if !program.has_said(is_told) {
                program.await_line("that there was no room", is_told);
            }
            // Its first announcement puts out none that just delivered, its next one is taken.
            deliver(&mut sender);
            program.await_line("its name", |line| line["sensor"] == "front" && line["class"] == "zones");
            let outcome = program.end(INT);
            let capacity = number(&outcome.of_class("lan_refused")[0], "capacity");
            assert_eq!((told(&outcome), capacity), (1, u64::from(is_delivered)), "{outcome}");
            let sums = &outcome.of_class("lan_evicted")[0];
            assert_eq!((&sums["runs"], &sums["evicted_active"]), (&json!(1), &json!(1)), "{outcome}");
        }
    });
}

#[test]
fn a_flood_of_invented_gateways_puts_out_none_that_delivers() {
    in_a_network("listen_crowd::a_flood_of_invented_gateways_puts_out_none_that_delivers", || {
        let env = TestEnv::new();
        let mut program = env.start(&["listen", "--json", "--topic=zones", NAME]).ready();
        let mut sender = Sender::new(HUB, 7, 0, "front");
        prove(&mut sender, |_| drop(program.await_line("it is heard", is_class("zones"))));
        const TURNS: u64 = 100;
        let mut invented = Sender::new(0, 7, 0, "other");
        for turn in 0..TURNS {
            for n in 0..40 {
                invented.hub = 40 * turn + n;
                invented.announce(&[Topic::Zones]);
                if n % 2 == 0 {
                    invented.send(Topic::Zones, &zones(Verdict::Clear));
                }
            }
            let topic_seq = sender.next[usize::from(Topic::Zones.number())];
            sender.send(Topic::Zones, &zones(Verdict::Stop));
            // What is read keeps the flood from running over the kernel's buffer.
            program.await_line("the true one", |line| {
                line["verdict"] == "stop" && line["topic_seq"] == json!(topic_seq)
            });
        }
        let outcome = program.end(INT);
        let row = zones_row(&outcome, "5f3a12bc00d1e2f3");
        assert_eq!((number(&row, "received"), number(&row, "lost")), (TURNS + 2, 0), "{row}");
        assert!(number(&outcome.of_class("lan_evicted")[0], "evicted_active") > 1000, "{outcome}");
        assert_eq!(told(&outcome), 1, "4000 of them, one line");
    });
}

fn publisher(env: &TestEnv) -> Program {
    env.start(&["listen", "--json", "--publish", NAME]).ready()
}

/// A true sensor, which is published when its gateway has delivered for a second. The sensor itself is not known to deliver
/// then: the samples before do not count for it.
fn published(program: &mut Program) -> Sender {
    let mut sender = Sender::new(HUB, 7, 0, "front");
    until("it is published", || {
        deliver(&mut sender);
        program.is_heard(|line| line["kind"] == "published" && line["sensor"] == "robot1.front")
    });
    sender.send(Topic::Status, &Status { state: State::Streaming as u8, ..Status::default() });
    sender
}

#[test]
fn a_true_sensor_is_published_at_once_after_16_invented_ones() {
    in_a_network("listen_crowd::a_true_sensor_is_published_at_once_after_16_invented_ones", || {
        let env = TestEnv::new();
        for is_delivered in [false, true] {
            let mut program = publisher(&env);
            for n in 0..16 {
                let mut sender = Sender::new(0xab, 7, n, &format!("s{n}"));
                sender.await_published(&mut program, &[Topic::Zones]);
                if is_delivered {
                    sender.send(Topic::Zones, &zones(Verdict::Stop));
                }
            }
            let mut sender = published(&mut program);
            await_verdict(&mut sender, &mut env.echo(&["robot1.front/zones"]), Verdict::Slow);
            let outcome = program.end(INT);
            assert_eq!(told(&outcome), 1, "{outcome}");
            let sensors = &outcome.of_class("lan_published")[0]["sensors"];
            assert_eq!(sensors.as_array().map(Vec::len), Some(16), "{outcome}");
            assert!(!sensors.to_string().contains("ab.s0\""), "the oldest made room: {sensors}");
        }
    });
}

#[test]
fn a_published_sensor_that_delivers_is_not_put_out() {
    in_a_network("listen_crowd::a_published_sensor_that_delivers_is_not_put_out", || {
        let env = TestEnv::new();
        let mut program = publisher(&env);
        let mut sender = published(&mut program);
        let mut echo = env.echo(&["robot1.front/zones"]);
        prove(&mut sender, |sender| await_verdict(sender, &mut echo, Verdict::Clear));
        let mut invented = Sender::new(0xab, 7, 0, "s");
        invented.await_published(&mut program, &[Topic::Zones]);
        for turn in 0..50_u8 {
            for n in 0..4 {
                (invented.sensor, invented.name) = (4 * turn + n, format!("s{turn}-{n}"));
                invented.announce(&[Topic::Zones]);
                invented.send(Topic::Zones, &zones(Verdict::Clear));
            }
            // Never twice the same, so that an earlier one is not taken for it.
            await_verdict(&mut sender, &mut echo, if turn % 2 == 0 { Verdict::Stop } else { Verdict::Slow });
        }
        let echoed = echo.end(INT);
        assert_eq!(echoed.of_class("summary")[0]["missed"], 0, "{echoed}");
        let outcome = program.end(INT);
        let line = &outcome.of_class("lan_published")[0];
        assert!(line["sensors"].to_string().contains("robot1.front"), "{line}");
        assert!(number(line, "capacity") > 0, "so many are not made at once: {line}");
        assert_eq!(told(&outcome), 1, "{outcome}");
    });
}

#[test]
fn who_follows_a_sensor_that_was_put_out_is_told_and_goes_on_when_it_is_back() {
    in_a_network(
        "listen_crowd::who_follows_a_sensor_that_was_put_out_is_told_and_goes_on_when_it_is_back",
        || {
            let env = TestEnv::new();
            let mut program = publisher(&env);
            let mut sender = published(&mut program);
            let mut echo = env.echo(&["robot1.front/zones"]);
            let mut others: Vec<_> = (0..16).map(|n| Sender::new(0xab, 7, n, &format!("s{n}"))).collect();
            others[0].await_published(&mut program, &[Topic::Zones, Topic::Status]);
            others.iter_mut().for_each(deliver);
            program.await_line("the last one", |line| line["sensor"] == "00000000000000ab.s15");
            echo.await_line("nothing is known any more", |line| line["verdict"] == "unknown");
            deliver(&mut sender);
            program.await_line("it is back", |line| line["sensor"] == "robot1.front");
            await_verdict(&mut sender, &mut echo, Verdict::Stop);
            drop((echo.end(INT), program.end(INT)));
            assert!(env.left_behind().is_empty(), "{:?}", env.left_behind());
        },
    );
}
