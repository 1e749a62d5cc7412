//! What the turns of scanners whose heads turn are like behind the whole hub, in virtual time: each model for ten minutes, a
//! hundred lines that lose bytes in bursts, a hundred hubs that stand still for half a second again and again. The figures of
//! docs/scanners.md: `cargo run --release -p scanhub-world --example turns`.

use std::fmt::Write as _;

use world::{Detail, Figures, Plan, run};

/// All that `plans` come to, and what the judges say of them.
fn judge(what: &str, plans: impl Iterator<Item = String>) {
    let (mut figures, mut broken, mut worlds) = (Figures::default(), Vec::new(), 0);
    for text in plans {
        let plan: Plan = text.parse().expect("a plan");
        let outcome = run(&plan, Detail::Nothing);
        figures.add(&outcome.figures);
        broken.extend(outcome.violations.into_iter().map(|violation| format!("{}: {violation}", plan.seed)));
        worlds += 1;
    }
    let Figures { scans, incomplete, points, angle_deg, range_mm, stamp_ns } = figures;
    println!(
        "{what}: {worlds} worlds, {scans} scans, {incomplete} of them incomplete, {points} points, at most {angle_deg:.3} degrees, \
         {range_mm:.2} mm and {:.2} ms off; {} broken promises",
        stamp_ns as f64 / 1e6,
        broken.len()
    );
    broken.iter().take(5).for_each(|broken| println!("  {broken}"));
}

/// Again and again what `action` says, every so many milliseconds for a minute.
fn often(every_ms: u64, action: &str) -> String {
    let mut actions = String::new();
    for at_ms in (3_000..48_000).step_by(every_ms as usize) {
        let _ = writeln!(actions, "{at_ms} {action}");
    }
    actions
}

fn main() {
    for model in ["ld06", "ld19", "stl19p", "stl27l", "ld14p"] {
        judge(
            &format!("{model}, ten minutes"),
            (1..2).map(|seed| format!("seed {seed} seconds 600 {model}")),
        );
    }
    let loss = often(10_000, "noise sensor=0 loss=135 flip=0 insert=0 double=0 burst=2 span_ms=9900");
    judge("ld19, burst loss", (0..100).map(|seed| format!("seed {seed} seconds 60 ld19\n{loss}")));
    let stalls = often(5_000, "stall span_ms=500");
    judge(
        "ld19, hub stands still for 0.5 s",
        (0..100).map(|seed| format!("seed {seed} seconds 60 ld19\n{stalls}")),
    );
    let stalls = often(6_000, "stall span_ms=2000");
    judge(
        "ld19, hub stands still for 2 s",
        (0..100).map(|seed| format!("seed {seed} seconds 60 ld19\n{stalls}")),
    );
}
