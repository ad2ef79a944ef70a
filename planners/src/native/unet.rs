//! The two U-Nets as plans.

use super::geometry::Kind;
use super::plan::{Builder, Plan, Step};
use crate::nets::{HalfJannerConfig, JannerConfig};

/// The way down: two blocks a level, a halving between levels; `down` is its index within a level, `remember` says
/// of which levels the activations are kept for the way up. Returns what is left of the length.
fn levels(
    builder: &mut Builder,
    (length, width): (usize, usize),
    channels: &[usize],
    taps: usize,
    down: usize,
    remember: impl Fn(usize) -> bool,
) -> usize {
    let (mut length, mut inputs) = (length, width);
    for (level, &outputs) in channels.iter().enumerate() {
        builder.block(&format!("downs.{level}.0"), taps, length, (inputs, outputs));
        builder.block(
            &format!("downs.{level}.1"),
            taps,
            length,
            (outputs, outputs),
        );
        if remember(level) {
            builder.step(Step::Push);
        }
        if level + 1 < channels.len() {
            let name = format!("downs.{level}.{down}.conv");
            length = halving(builder, &name, length, outputs);
        }
        inputs = outputs;
    }
    length
}

fn halving(builder: &mut Builder, name: &str, length: usize, channels: usize) -> usize {
    let layer = builder.layer(name, Kind::Halving, length, (channels, channels));
    builder.step(Step::Layer(layer));
    Kind::Halving.output_length(length)
}

/// `JannerUNet1d`. What the first level remembers is never used in the reference, and not remembered here.
pub(super) fn janner(config: &JannerConfig) -> Plan {
    let channels = config.channels();
    let taps = config.kernel_size;
    let input = (config.horizon, config.width);
    let mut builder = Builder::default();
    let mut length = levels(&mut builder, input, &channels, taps, 3, |level| level > 0);
    let last = channels[channels.len() - 1];
    builder.block("mid_block1", taps, length, (last, last));
    builder.block("mid_block2", taps, length, (last, last));
    for (level, pair) in channels.windows(2).rev().enumerate() {
        let (outputs, inputs) = (pair[0], pair[1]);
        builder.step(Step::Concat {
            length,
            channels: inputs,
            skip: inputs,
        });
        builder.block(
            &format!("ups.{level}.0"),
            taps,
            length,
            (2 * inputs, outputs),
        );
        builder.block(&format!("ups.{level}.1"), taps, length, (outputs, outputs));
        let name = format!("ups.{level}.3.conv");
        let layer = builder.layer(&name, Kind::Doubling, length, (outputs, outputs));
        builder.step(Step::Layer(layer));
        length *= 2;
    }
    let dim = config.model_dim;
    let kind = Kind::Same { taps: 5 };
    let first = builder.layer("final_conv.0", kind, length, (channels[0], dim));
    builder.step(Step::Layer(first));
    let norm = builder.norm("final_conv.1", length, dim);
    builder.step(Step::Norm(norm));
    let kind = Kind::Same { taps: 1 };
    let second = builder.layer("final_conv.3", kind, length, (dim, config.width));
    builder.step(Step::Layer(second));
    let time = builder.time(config.embedding, config.embedding_dim, dim);
    builder.finish(Some(time), input, input)
}

/// `HalfJannerUNet1d`.
pub(super) fn half_janner(config: &HalfJannerConfig) -> Plan {
    let channels = config.channels();
    let input = (config.horizon, config.width);
    let taps = config.kernel_size;
    let mut builder = Builder::default();
    let mut length = levels(&mut builder, input, &channels, taps, 2, |_| false);
    let mut inputs = channels[channels.len() - 1];
    for (index, outputs) in config.middle_channels().into_iter().enumerate() {
        let name = format!("mid_block{}", index + 1);
        builder.block(&format!("{name}.0"), 5, length, (inputs, outputs));
        length = halving(&mut builder, &format!("{name}.1.conv"), length, outputs);
        inputs = outputs;
    }
    builder.step(Step::Flatten {
        length,
        channels: inputs,
    });
    let flat = config.flat_len();
    let sizes = (flat + config.model_dim, flat / 2);
    let first = builder.linear("final_block.0", sizes);
    builder.step(Step::Layer(first));
    builder.step(Step::Mish);
    let second = builder.linear("final_block.2", (flat / 2, config.out_dim));
    builder.step(Step::Layer(second));
    let time = builder.time(config.embedding, config.embedding_dim, config.model_dim);
    builder.finish(Some(time), input, (1, config.out_dim))
}
