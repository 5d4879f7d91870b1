//! Retrieval of the mapped frames most similar to a view, by the cosine of their features.

use ndarray::{Array2, ArrayView1, ArrayView2};

/// Features of mapped frames, scaled to unit length.
#[derive(Debug, Clone)]
pub struct UnitFeatures {
    rows: Array2<f32>,
}

impl UnitFeatures {
    /// Scales features, shape (n, d).
    pub fn of(features: ArrayView2<'_, f32>) -> Self {
        let mut rows = features.to_owned();
        for mut row in rows.rows_mut() {
            let length = row.dot(&row).sqrt().max(1e-12);
            row /= length;
        }

        Self { rows }
    }

    /// Rows of the `count` most similar frames, the most similar first.
    pub fn nearest(&self, feature: ArrayView1<'_, f32>, count: usize) -> Vec<usize> {
        let similarity = self.rows.dot(&feature);
        let mut order: Vec<usize> = (0..similarity.len()).collect();
        let by_similarity =
            |a: &usize, b: &usize| similarity[*b].total_cmp(&similarity[*a]).then(a.cmp(b));
        if count < order.len() {
            order.select_nth_unstable_by(count, by_similarity);
            order.truncate(count);
        }
        order.sort_by(by_similarity);
        order
    }

    /// Cosine similarity of the frame in `row` and a feature of shape (d).
    pub fn similarity(&self, row: usize, feature: ArrayView1<'_, f32>) -> f32 {
        let length = feature.dot(&feature).sqrt().max(1e-12);
        self.rows.row(row).dot(&feature) / length
    }
}
