//! The lines of people: where they are, and what happened to them. Not a contract, like its parent module.

use std::io::{self, Write};

use scanhub_schema::{Event, EventKind, Header, Tracks};

use super::numbers;

pub(crate) fn tracks(line: &mut Vec<u8>, header: &Header, tracks: &Tracks) -> io::Result<()> {
    numbers(line, header)?;
    let count = tracks.tracks().len();
    write!(line, " {count} {}", if count == 1 { "person" } else { "people" })?;
    for track in tracks.tracks() {
        let (x_m, y_m, state) = (track.x_m, track.y_m, track.state().name());
        write!(line, ", {} {state} at ({x_m:.2}, {y_m:.2}) m", track.id)?;
        if let Some(room) = track.room_name() {
            write!(line, " in {room}")?;
        }
    }
    Ok(())
}

pub(crate) fn event(line: &mut Vec<u8>, header: &Header, event: &Event) -> io::Result<()> {
    numbers(line, header)?;
    write!(line, " ")?;
    event_words(line, event)
}

/// Writes an event as a sentence.
///
/// # Errors
///
/// Returns the error of the write.
pub fn event_words(line: &mut Vec<u8>, event: &Event) -> io::Result<()> {
    let (id, room) = (event.id, event.room_name().unwrap_or("no room"));
    match (event.kind(), event.door()) {
        (_, Some((door, from, to))) => write!(line, "{id} went from {from} to {to} through {door}"),
        (Some(EventKind::Appeared), _) => write!(line, "{id} appeared in {room}"),
        (Some(EventKind::Left), _) => write!(line, "{id} left, last in {room}"),
        _ => write!(line, "{id}: event {}", event.kind),
    }
}
