//! Tables of quantities that were measured for several numbers of subscribers, sensors or beams. Fits show how the
//! quantities grow with these numbers.

use crate::support::figures::{self, Cell, percentile};

/// A quantity that is measured for several numbers of items, such as subscribers.
pub(crate) struct Quantity {
    pub(crate) name: &'static str,
    pub(crate) unit: &'static str,
    /// Exponent that the quantity has if the cost of all items grows linearly. It is 0 for a cost per item, and 1 for
    /// the cost of all items. `None` if the growth is not evaluated.
    pub(crate) linear: Option<f64>,
}

/// Values of several quantities, measured for several numbers of items.
pub(crate) struct ParameterRange {
    title: String,
    /// Name of the items, such as `subscribers`.
    counted: &'static str,
    quantities: Vec<Quantity>,
    /// Rows of the table, in order. Each row has the number of items, and for each quantity the values of all runs.
    rows: Vec<(usize, Vec<Vec<f64>>)>,
}

/// Growth of a quantity, from the medians of its runs.
#[derive(Clone, Copy, Debug)]
struct Growth {
    /// Parameters of the fit `fixed + per_item * n`, which minimizes the squares of relative errors.
    fixed: f64,
    per_item: f64,
    /// Slope of the logarithms for large numbers of items. It is 1 if the quantity grows linearly.
    exponent: f64,
}

impl ParameterRange {
    /// Creates a range without values.
    pub(crate) fn new(title: &str, counted: &'static str, quantities: Vec<Quantity>) -> ParameterRange {
        ParameterRange { title: title.to_owned(), counted, quantities, rows: Vec::new() }
    }

    /// Adds the values of one run with `number` items. `values` has one value for each quantity, in the same order.
    pub(crate) fn add(&mut self, number: usize, values: &[f64]) {
        if self.rows.last().is_none_or(|(last, _)| *last != number) {
            self.rows.push((number, vec![Vec::new(); self.quantities.len()]));
        }
        if let Some((_, row)) = self.rows.last_mut() {
            row.iter_mut().zip(values).for_each(|(cell, value)| cell.push(*value));
        }
    }

    /// Prints the values and their growth.
    pub(crate) fn print(&self, is_json: bool) {
        figures::print_cells("subscribers", is_json, &self.cells());
        figures::print_cells("subscribers", is_json, &self.growths(is_json));
    }

    fn cells(&self) -> Vec<Cell> {
        let cell = |number: usize, quantity: &Quantity, values: &[f64]| Cell {
            table: self.title.clone(),
            row: format!("{number} {}", self.counted),
            column: quantity.name.to_owned(),
            unit: quantity.unit,
            values: values.to_vec(),
        };
        let row = |(number, row): &(usize, Vec<Vec<f64>>)| {
            let cells = self.quantities.iter().zip(row);
            cells.map(|(quantity, values)| cell(*number, quantity, values)).collect::<Vec<_>>()
        };
        self.rows.iter().flat_map(row).collect()
    }

    /// Returns the fits as cells, and prints which quantities grow faster than linearly.
    fn growths(&self, json: bool) -> Vec<Cell> {
        let mut cells = Vec::new();
        for (at, quantity) in self.quantities.iter().enumerate() {
            let (Some(linear), Some(growth)) = (quantity.linear, Growth::of(&self.medians(at))) else {
                continue;
            };
            let columns = [
                ("fixed", quantity.unit, growth.fixed),
                ("for each", quantity.unit, growth.per_item),
                ("exponent", "1", growth.exponent),
                ("exponent of linear growth", "1", linear),
            ];
            cells.extend(columns.map(|(column, unit, value)| Cell {
                table: format!("growth, {}", self.title),
                row: quantity.name.to_owned(),
                column: column.to_owned(),
                unit,
                values: vec![value],
            }));
            if !json && growth.exponent > linear + EXPONENT_TOLERANCE {
                println!("{}: {} grows WORSE THAN LINEARLY", self.title, quantity.name);
            }
        }
        cells
    }

    /// Returns the median of the quantity with index `at` for each number of items.
    fn medians(&self, at: usize) -> Vec<(f64, f64)> {
        let median = |(number, row): &(usize, Vec<Vec<f64>>)| {
            let mut sorted = row[at].clone();
            sorted.sort_by(f64::total_cmp);
            Some((*number as f64, percentile(&sorted, 0.5)?))
        };
        self.rows.iter().filter_map(median).collect()
    }
}

impl Growth {
    /// Returns the growth over `points`. Returns `None` for fewer than three points, or if a value is zero.
    fn of(points: &[(f64, f64)]) -> Option<Growth> {
        let greatest = points.last()?.0;
        if points.len() < 3 || points.iter().any(|&(n, value)| n <= 0.0 || value <= 0.0) {
            return None;
        }
        let (fixed, per_item) = line(points.iter().map(|&(n, value)| (n, value, 1.0 / (value * value))))?;
        let far = points.iter().filter(|(n, _)| n * LARGE_FACTOR >= greatest);
        let near = points.len().saturating_sub(3);
        // Use at least three points. With two points, the slope would only show the spread of two runs.
        let far: Vec<_> =
            if far.clone().count() < 3 { points[near..].to_vec() } else { far.copied().collect() };
        let (_, exponent) = line(far.iter().map(|(n, value)| (n.ln(), value.ln(), 1.0)))?;
        Some(Growth { fixed, per_item, exponent })
    }
}

/// Returns a and b of the line `a + b x` that fits `points` best, by the smallest weighted sum of squared errors. A
/// point is `(x, value, weight)`.
fn line(points: impl Iterator<Item = (f64, f64, f64)>) -> Option<(f64, f64)> {
    let [mut weights, mut x, mut y, mut xx, mut xy] = [0.0; 5];
    for (at, value, weight) in points {
        weights += weight;
        x += weight * at;
        y += weight * value;
        xx += weight * at * at;
        xy += weight * at * value;
    }
    let spread = weights * xx - x * x;
    let slope = (weights * xy - x * y) / spread;
    (spread > 0.0).then(|| ((y - slope * x) / weights, slope))
}

/// Factor that defines large numbers of items. A number is large if it is at least the largest number divided by this
/// factor.
const LARGE_FACTOR: f64 = 16.0;
/// Tolerance for the exponent. If it exceeds the exponent of linear growth by no more than this, the spread of a few
/// runs can explain the difference.
const EXPONENT_TOLERANCE: f64 = 0.25;
