//! Prints the combined verdict of the robot's sensors whenever it changes: `cargo run --example stop`.

use scanhub_client::{Error, robot};

fn main() -> Result<(), Error> {
    let mut robot = robot(&[])?;
    let mut last = None;
    loop {
        let now = robot.next()?;
        if last != Some(now.verdict()) {
            last = Some(now.verdict());
            println!("{}, {}", now.verdict().name(), now.worst().unwrap_or("no sensor"));
        }
    }
}
