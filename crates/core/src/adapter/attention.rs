//! The attention corrector. A latent token and a motion token pass through one pre-norm transformer
//! block (4 heads, feed-forward width 256). A linear layer maps their mean to the output.
//!
//! The block is PyTorch's `TransformerEncoderLayer(64, 4, 256, activation="gelu", norm_first=True)`
//! without dropout. The two tokens of n samples are stored as 2n rows: first the n latent tokens,
//! then the n motion tokens.

use ndarray::{Array2, ArrayView2, Axis, concatenate, s};

use super::Real;
use super::layers::{
    cumulative, gelu_backward, linear, linear_initial, normalize, normalize_backward, within,
};
use super::seeded::Seeded;

/// Columns of a token.
const WIDTH: usize = 64;
const HEADS: usize = 4;
/// Width of an attention head.
const HEAD: usize = WIDTH / HEADS;
/// Width of the feed-forward layer.
const INNER: usize = 256;

/// Index of each weight in [`Attention::tensors`]; its bias is at the next index.
const TOKEN_G: usize = 0;
const TOKEN_P: usize = 2;
const OUT: usize = 4;
const IN_PROJECTION: usize = 6;
const OUT_PROJECTION: usize = 8;
const FIRST: usize = 10;
const SECOND: usize = 12;
const NORM_1: usize = 14;
const NORM_2: usize = 16;

/// PyTorch's names of the tensors, in the order of [`Attention::tensors`].
const NAMES: [&str; 18] = [
    "tok_g.weight",
    "tok_g.bias",
    "tok_p.weight",
    "tok_p.bias",
    "out.weight",
    "out.bias",
    "block.self_attn.in_proj_weight",
    "block.self_attn.in_proj_bias",
    "block.self_attn.out_proj.weight",
    "block.self_attn.out_proj.bias",
    "block.linear1.weight",
    "block.linear1.bias",
    "block.linear2.weight",
    "block.linear2.bias",
    "block.norm1.weight",
    "block.norm1.bias",
    "block.norm2.weight",
    "block.norm2.bias",
];

/// Parameters of the corrector.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Attention<T> {
    tensors: [Array2<T>; 18],
}

/// Attention weights of one sample, indexed by head, query token and key token.
type AttentionWeights<T> = [[[T; 2]; 2]; HEADS];

/// Intermediate values and output of a LayerNorm's forward pass.
struct Normed<T> {
    normalized: Array2<T>,
    inverse_deviation: Array2<T>,
    output: Array2<T>,
}

/// Intermediate values of the forward pass that the backward pass uses.
pub(super) struct Activations<T> {
    latents: Array2<T>,
    motions: Array2<T>,
    before: Normed<T>,
    /// Queries, keys and values, shape (2n, 3·64).
    projected: Array2<T>,
    /// Attention weights, one entry for each sample.
    looks: Vec<AttentionWeights<T>>,
    seen: Array2<T>,
    between: Normed<T>,
    inner: Array2<T>,
    inner_cumulative: Array2<T>,
    inner_passed: Array2<T>,
    mean: Array2<T>,
    pub output: Array2<T>,
}

impl<T: Real> Attention<T> {
    /// Initial weights, drawn in the order of PyTorch's module constructors.
    pub fn random(coordinates: usize, random: &mut Seeded) -> Self {
        let [token_g, token_g_bias] = linear_initial(coordinates, WIDTH, random);
        let [token_p, token_p_bias] = linear_initial(6, WIDTH, random);
        let [out, out_bias] = linear_initial(WIDTH, coordinates, random);

        // PyTorch draws this bias and then sets it to zero. It is drawn here too, to keep the
        // random stream aligned.
        let [out_projection, _] = linear_initial(WIDTH, WIDTH, random);

        // Xavier-uniform initialization, ±√(6 / (fan_in + fan_out)). The query, key and value
        // projections are stacked in one tensor, so fan_out = 3 · WIDTH.
        let in_projection = within(3 * WIDTH, WIDTH, (6.0 / (4 * WIDTH) as f64).sqrt(), random);
        let [first, first_bias] = linear_initial(WIDTH, INNER, random);
        let [second, second_bias] = linear_initial(INNER, WIDTH, random);

        let zeros = |width| Array2::zeros((1, width));
        let ones = || Array2::ones((1, WIDTH));

        Self {
            tensors: [
                token_g,
                token_g_bias,
                token_p,
                token_p_bias,
                out,
                out_bias,
                in_projection,
                zeros(3 * WIDTH),
                out_projection,
                zeros(WIDTH),
                first,
                first_bias,
                second,
                second_bias,
                ones(),
                zeros(WIDTH),
                ones(),
                zeros(WIDTH),
            ],
        }
    }

    pub fn names(&self) -> Vec<String> {
        NAMES.map(str::to_owned).to_vec()
    }

    pub fn parameters(&self) -> Vec<&Array2<T>> {
        self.tensors.iter().collect()
    }

    pub fn parameters_mut(&mut self) -> Vec<&mut Array2<T>> {
        self.tensors.iter_mut().collect()
    }

    pub fn cast<U: Real>(&self) -> Attention<U> {
        Attention {
            tensors: self
                .tensors
                .each_ref()
                .map(|tensor| tensor.mapv(|x| U::of(x.f64()))),
        }
    }

    /// Number of coordinates of a latent.
    pub fn coordinates(&self) -> usize {
        self.tensors[OUT].nrows()
    }

    fn linear(&self, input: &Array2<T>, at: usize) -> Array2<T> {
        linear(input, &self.tensors[at], &self.tensors[at + 1])
    }

    fn norm(&self, input: &Array2<T>, at: usize) -> Normed<T> {
        let mut normalized = input.clone();
        let inverse_deviation = normalize(&mut normalized);
        let output = &normalized * &self.tensors[at] + &self.tensors[at + 1];

        Normed {
            normalized,
            inverse_deviation,
            output,
        }
    }

    pub fn forward(&self, latents: Array2<T>, motions: Array2<T>) -> Activations<T> {
        let n = latents.nrows();
        let half = T::of(0.5);

        // One token for the latent, one for the motion.
        let tokens = stacked(
            self.linear(&latents, TOKEN_G).view(),
            self.linear(&motions, TOKEN_P).view(),
        );
        let before = self.norm(&tokens, NORM_1);
        let projected = self.linear(&before.output, IN_PROJECTION);
        let (looks, seen) = attend(&projected, n);

        // Pre-norm block: the inputs of attention and feed-forward layer are normalized; the
        // residual connections bypass the norm.
        let middle = tokens + self.linear(&seen, OUT_PROJECTION);
        let between = self.norm(&middle, NORM_2);
        let inner = self.linear(&between.output, FIRST);
        let inner_cumulative = cumulative(&inner);
        let inner_passed = &inner * &inner_cumulative;
        let last = middle + self.linear(&inner_passed, SECOND);
        let mean = (&last.slice(s![..n, ..]) + &last.slice(s![n.., ..])) * half;

        let output = self.linear(&mean, OUT);
        Activations {
            latents,
            motions,
            before,
            projected,
            looks,
            seen,
            between,
            inner,
            inner_cumulative,
            inner_passed,
            mean,
            output,
        }
    }

    /// Adds the gradient of the parameters to `gradient`; `d_output` is the gradient with respect
    /// to the output.
    pub fn backward(&self, forward: &Activations<T>, d_output: &Array2<T>, gradient: &mut Self) {
        let n = d_output.nrows();

        // The steps of `forward` in reverse. The output reads the mean of both tokens, hence the
        // factor 1/2.
        let d_mean = self.linear_backward(OUT, &forward.mean, d_output, gradient) * T::of(0.5);
        let mut d_rows = stacked(d_mean.view(), d_mean.view());
        let mut d_inner = self.linear_backward(SECOND, &forward.inner_passed, &d_rows, gradient);
        gelu_backward(&mut d_inner, &forward.inner, &forward.inner_cumulative);

        // `d_rows` is the gradient along the residual connections. The feed-forward layer and the
        // attention add their gradients to it.
        let d_between = self.linear_backward(FIRST, &forward.between.output, &d_inner, gradient);
        d_rows += &self.norm_backward(NORM_2, &forward.between, d_between, gradient);
        let d_seen = self.linear_backward(OUT_PROJECTION, &forward.seen, &d_rows, gradient);
        let d_projected = attend_backward(&forward.projected, &forward.looks, &d_seen);

        let d_before = self.linear_backward(
            IN_PROJECTION,
            &forward.before.output,
            &d_projected,
            gradient,
        );
        d_rows += &self.norm_backward(NORM_1, &forward.before, d_before, gradient);

        // The upper n rows are latent tokens, the lower n are motion tokens.
        let d_g = d_rows.slice(s![..n, ..]).to_owned();
        let d_p = d_rows.slice(s![n.., ..]).to_owned();
        self.linear_backward(TOKEN_G, &forward.latents, &d_g, gradient);
        self.linear_backward(TOKEN_P, &forward.motions, &d_p, gradient);
    }

    fn linear_backward(
        &self,
        at: usize,
        input: &Array2<T>,
        d: &Array2<T>,
        gradient: &mut Self,
    ) -> Array2<T> {
        gradient.tensors[at] += &d.t().dot(input);
        gradient.tensors[at + 1] += &d.sum_axis(Axis(0));
        d.dot(&self.tensors[at])
    }

    fn norm_backward(
        &self,
        at: usize,
        forward: &Normed<T>,
        d: Array2<T>,
        gradient: &mut Self,
    ) -> Array2<T> {
        gradient.tensors[at] += &(&d * &forward.normalized).sum_axis(Axis(0));
        gradient.tensors[at + 1] += &d.sum_axis(Axis(0));
        let mut d = d * &self.tensors[at];
        normalize_backward(&mut d, &forward.normalized, &forward.inverse_deviation);

        d
    }
}

fn stacked<T: Real>(above: ArrayView2<'_, T>, below: ArrayView2<'_, T>) -> Array2<T> {
    // This cannot fail: both parts are as wide as a token.
    concatenate(Axis(0), &[above, below]).unwrap_or_default()
}

/// Columns of one head in the projection; `part` is 0 for queries, 1 for keys and 2 for values.
fn columns(part: usize, head: usize) -> std::ops::Range<usize> {
    let first = part * WIDTH + head * HEAD;
    first..first + HEAD
}

/// Scaled dot-product attention between the two tokens of each sample. Returns the attention
/// weights and, for each token, the weighted mean of the values.
fn attend<T: Real>(projected: &Array2<T>, n: usize) -> (Vec<AttentionWeights<T>>, Array2<T>) {
    let scale = T::of((HEAD as f64).sqrt().recip());
    let mut seen = Array2::zeros((2 * n, WIDTH));
    let mut looks = Vec::with_capacity(n);
    for sample in 0..n {
        // The latent token is in the upper half of the rows, the motion token in the lower half.
        let rows = [sample, sample + n];
        let mut of_sample = [[[T::zero(); 2]; 2]; HEADS];
        for (head, of_head) in of_sample.iter_mut().enumerate() {
            let part =
                |part: usize, token: usize| projected.slice(s![rows[token], columns(part, head)]);
            for (token, look) in of_head.iter_mut().enumerate() {
                let scores = [0, 1].map(|other| part(0, token).dot(&part(1, other)) * scale);

                // Softmax over the two keys. The largest score is subtracted to avoid overflow.
                let largest = scores[0].max(scores[1]);
                let shares = scores.map(|score| (score - largest).exp());
                *look = shares.map(|share| share / (shares[0] + shares[1]));

                let mut into = seen.slice_mut(s![rows[token], head * HEAD..(head + 1) * HEAD]);
                into.scaled_add(look[0], &part(2, 0));
                into.scaled_add(look[1], &part(2, 1));
            }
        }

        looks.push(of_sample);
    }

    (looks, seen)
}

/// Gradient with respect to `projected`, from `d_seen`, the gradient with respect to the
/// attention's output.
fn attend_backward<T: Real>(
    projected: &Array2<T>,
    looks: &[AttentionWeights<T>],
    d_seen: &Array2<T>,
) -> Array2<T> {
    let scale = T::of((HEAD as f64).sqrt().recip());
    let mut d_projected = Array2::zeros(projected.dim());
    for (sample, of_sample) in looks.iter().enumerate() {
        let rows = [sample, sample + looks.len()];
        for (head, of_head) in of_sample.iter().enumerate() {
            let part =
                |part: usize, token: usize| projected.slice(s![rows[token], columns(part, head)]);
            for (token, look) in of_head.iter().enumerate() {
                let d = d_seen.slice(s![rows[token], head * HEAD..(head + 1) * HEAD]);

                // Softmax backward, with weights a and scores s: ds_j = a_j (da_j − Σ_i a_i da_i).
                // `mean` is the sum over i.
                let d_look = [0, 1].map(|other| d.dot(&part(2, other)));
                let mean = look[0] * d_look[0] + look[1] * d_look[1];
                for other in 0..2 {
                    d_projected
                        .slice_mut(s![rows[other], columns(2, head)])
                        .scaled_add(look[other], &d);

                    // The score is q·k/√HEAD: its gradient is along k for the query and along q for
                    // the key.
                    let d_score = look[other] * (d_look[other] - mean) * scale;
                    d_projected
                        .slice_mut(s![rows[token], columns(0, head)])
                        .scaled_add(d_score, &part(1, other));

                    d_projected
                        .slice_mut(s![rows[other], columns(1, head)])
                        .scaled_add(d_score, &part(0, token));
                }
            }
        }
    }

    d_projected
}
