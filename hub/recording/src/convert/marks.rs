//! Recorded marks as lines of CSV.

use std::io::{self, Write};

use schema::csv::MarkColumns;
use schema::datagram::Packed;
use schema::{Failure, Kind, Marks, Topic};

use super::{Packing, Written};
use crate::mcap::Item;
use crate::{Form, Recording};

/// Writes the marks of the chosen sensor of `recording`, and returns their number.
///
/// # Errors
///
/// Returns [`Kind::NoTopic`] if none were recorded. Otherwise the error of `count`, or of the output as `failed` makes it.
pub(super) fn write(
    recording: &Recording,
    columns: MarkColumns,
    mut out: Packing<impl Write>,
    count: &mut impl FnMut(Written, Option<u64>) -> Result<(), Failure>,
    failed: &impl Fn(io::Error) -> Failure,
) -> Result<u64, Failure> {
    let mut lines = Vec::new();
    columns.names(&mut lines).map_err(failed)?;
    let (mut samples, mut written) = (0, 0);
    if recording.contents().form == Form::Mcap {
        let (mut reader, catalog) = recording.reader()?;
        while let Some(item) = reader.next().map_err(|error| recording.broken(&error))? {
            let Item::Record(record) = item else { continue };
            let Some((place, header, payload)) = catalog.message(&record) else { continue };
            let mut marks = Marks::default();
            if place.topic != Topic::Marks
                || recording.chosen() != Some(&place.sensor)
                || !marks.unpack(payload)
            {
                continue;
            }
            columns.rows(&mut lines, &header, &marks).map_err(failed)?;
            out.write_all(&lines).map_err(failed)?;
            lines.clear();
            samples += 1;
            written += marks.marks().len() as u64;
            count(Written::Marks, Some(header.wall_ns))?;
        }
    }
    if samples == 0 {
        let path = recording.path().display();
        let message = format!("there are no recorded marks in {path}");
        let hint = format!(
            "`scanhub replay {path}` finds marks in the scans, and meanwhile `scanhub record SENSOR/marks` records them"
        );
        return Err(Failure::new(Kind::NoTopic, message, hint));
    }
    out.finish().map_err(failed)?;
    Ok(written)
}
