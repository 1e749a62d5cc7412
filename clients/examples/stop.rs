//! Whether the robot may go, said when it changes: `cargo run --example stop`.

use clients::robot;
use schema::{Failure, Verdict};

fn main() -> Result<(), Failure> {
    let mut robot = robot(&[])?;
    let mut last = Verdict::Unknown;
    loop {
        let now = robot.next()?;
        if now.verdict() != last {
            last = now.verdict();
            println!("{}, {}", last.name(), now.worst().unwrap_or("no sensor"));
        }
    }
}
