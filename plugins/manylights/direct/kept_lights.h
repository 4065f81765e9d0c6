#pragma once

/**
 * Candidates to kept lights: each candidate gets a slot with C = 1 / p, or m of them are
 * resampled with the heuristic H. Where shadow rays are chosen later, each kept light gets
 * its target |C F|, F a sample without visibility.
 */

#include "light_samples.h"
#include "manylights/choice/reservoirs.h"
#include <variant>

namespace manylights {

/// The lights that reach stage 3, at most one in each slot
template <typename Float, typename Spectrum> struct Kept {
    using FloatD  = dr::detached_t<Float>;
    using UInt32D = dr::uint32_array_t<FloatD>;
    using Sample  = RaySample<Float, Spectrum>;
    using Samples =
        std::conditional_t<dr::is_jit_v<Float>, std::monostate, FixedArray<Sample>>;

    Slots<UInt32D> light;
    /// Contribution weight C (0: empty), inclusion probability, target g
    Slots<FloatD> weight, probability, target;
    /// What the targets are of, see \ref Strategy::keeps_samples
    Samples sample;
    DRJIT_STRUCT(Kept, light, weight, probability, target)

    explicit Kept(const Strategy &strategy)
        : light(make_slots<UInt32D>(strategy.slots, 0u)),
          weight(make_slots<FloatD>(strategy.slots, 0.f)),
          probability(make_slots<FloatD>(strategy.slots, 1.f)),
          target(make_slots<FloatD>(strategy.items, 0.f)) {
        if constexpr (!dr::is_jit_v<Float>)
            if (strategy.keeps_samples)
                sample = Samples(strategy.slots, dr::zeros<Sample>());
    }
};

template <typename Float, typename Spectrum> class KeptLights {
public:
    MI_IMPORT_TYPES()
    using Lights  = SceneLights<Float, Spectrum>;
    using Samples = LightSamples<Float, Spectrum>;
    using Sample  = typename Samples::Sample;
    using Vertex  = typename Samples::Vertex;
    using FloatD  = typename Lights::FloatD;
    using UInt32D = typename Lights::UInt32D;
    using MaskD   = typename Lights::MaskD;
    using Rng     = VertexRng<FloatD>;
    using Kept    = manylights::Kept<Float, Spectrum>;

    KeptLights(const Lights &lights, const Strategy &strategy, const Samples &samples)
        : m_lights(lights), m_strategy(strategy), m_samples(samples) {}

    /// Choices are not differentiated: no gradient passes through here
    MI_NOINLINE Kept keep(const Vertex &vertex, Counts<Float> &counts,
                          Mask active) const {
        dr::suspend_grad<Float> detached;
        LightSample<FloatD> u = plain_sample(vertex.u);
        return m_strategy.with_source<FloatD>(vertex.depth, [&](const auto &source) {
            auto cursor = source.cursor(m_lights.tree(), vertex, u.tree);
            return m_strategy.fate == Fate::KeepAll
                       ? keep_candidates(vertex, cursor, u, counts, active)
                       : keep_resampled(vertex,
                                        resample(vertex.at, cursor, u, counts, active),
                                        counts, active);
        });
    }

private:
    /// No more candidates than slots: keep each with C = 1 / p
    template <typename Cursor>
    Kept keep_candidates(const Vertex &vertex, const Cursor &cursor,
                         const LightSample<FloatD> &u, Counts<Float> &counts,
                         Mask active) const {
        struct State {
            Cursor cursor;
            Kept kept;
            Rng rng;
            UInt32D slot;
            FloatD expected;
            DRJIT_STRUCT(State, cursor, kept, rng, slot, expected)
            State(const Cursor &cursor, Kept &&kept, Rng &&rng)
                : cursor(cursor), kept(std::move(kept)), rng(std::move(rng)), slot(0),
                  expected(0.f) {}
        };
        State state(cursor, Kept(m_strategy), make_rng(u));
        MaskD on = plain(active);
        loop(
            state,
            [&](const State &s) {
                return on && s.cursor.has_next() && s.slot < m_strategy.slots;
            },
            [&](State &s) {
                // Keep the next candidate
                auto candidate = s.cursor.next(m_lights.tree(), vertex.at, s.rng);
                FloatD p = candidate.probability, weight = dr::rcp(p);
                MaskD valid = candidate.valid;
                Kept &kept  = s.kept;
                write_slot<UInt32D>(kept.light, s.slot, candidate.light, m_strategy.slots,
                                    valid);
                write_slot<FloatD>(kept.weight, s.slot, weight, m_strategy.slots, valid);
                write_slot<FloatD>(kept.probability, s.slot, p, m_strategy.slots, valid);
                // Evaluate its target, by which shadow rays are chosen
                FloatD g = light_target(vertex, candidate.light, p, s.slot, kept,
                                        active && valid) *
                           candidate.visibility;
                if (m_strategy.params.counts)
                    s.expected +=
                        m_samples.expected(weight * g, candidate.visibility, valid);
                if (m_lights.groups().evens())
                    g *= evening(candidate.light, active && valid);
                write_slot<FloatD>(kept.target, s.slot, weight * g, m_strategy.items,
                                   valid);
                s.slot += dr::select(valid, UInt32D(1), UInt32D(0));
            },
            "Direct light: candidates");
        counts.add(state.slot, state.cursor.visits, active);
        counts.expected += state.expected;
        return std::move(state.kept);
    }

    /// Stage 2: deal the candidates to m reservoirs
    template <typename Cursor>
    Reservoirs<FloatD> resample(const Receiver<FloatD> &at, const Cursor &cursor,
                                const LightSample<FloatD> &u, Counts<Float> &counts,
                                Mask active) const {
        struct State {
            Cursor cursor;
            Reservoirs<FloatD> reservoirs;
            Rng rng;
            UInt32D candidates;
            DRJIT_STRUCT(State, cursor, reservoirs, rng, candidates)
            State(const Cursor &cursor, size_t count, Rng &&rng)
                : cursor(cursor), reservoirs(count), rng(std::move(rng)), candidates(0) {}
        };
        const auto &tree = m_lights.tree();
        Dealing dealing =
            m_strategy.params.method == Method::Talk ? Dealing::Random : Dealing::Greedy;
        State state(cursor, m_strategy.slots, make_rng(u));
        MaskD on = plain(active);
        loop(
            state, [&](const State &s) { return on && s.cursor.has_next(); },
            [&](State &s) {
                auto candidate = s.cursor.next(tree, at, s.rng);
                FloatD h = light_importance(at, tree.row(candidate.light), tree.kinds,
                                            tree.scale) *
                           candidate.visibility;
                s.reservoirs.add(candidate, h, m_strategy.slots, dealing, s.rng);
                s.candidates += 1u;
            },
            "Direct light: resampled candidates");
        counts.add(state.candidates, state.cursor.visits, active);
        return std::move(state.reservoirs);
    }

    /// C = W / H, and the targets
    Kept keep_resampled(const Vertex &vertex, const Reservoirs<FloatD> &reservoirs,
                        Counts<Float> &counts, Mask active) const {
        struct State {
            UInt32D slot;
            Slots<FloatD> target;
            FloatD expected;
            DRJIT_STRUCT(State, slot, target, expected)
        };
        Kept kept(m_strategy);
        kept.light       = reservoirs.light;
        kept.probability = reservoirs.probability;
        for (size_t i = 0; i < m_strategy.slots; ++i)
            kept.weight[i] = reservoirs.weight[i] / reservoirs.importance[i];
        if (!m_strategy.chooses && !m_strategy.params.counts)
            return kept;

        State state{ UInt32D(0), kept.target, FloatD(0.f) };
        MaskD on = plain(active);
        loop(
            state, [&](const State &s) { return on && s.slot < m_strategy.slots; },
            [&](State &s) {
                FloatD weight = read_slot<FloatD>(kept.weight, s.slot, m_strategy.slots);
                FloatD target = light_target(
                    vertex, read_slot<UInt32D>(kept.light, s.slot, m_strategy.slots),
                    read_slot<FloatD>(kept.probability, s.slot, m_strategy.slots), s.slot,
                    kept, active && weight > 0.f);
                FloatD visibility =
                    read_slot<FloatD>(reservoirs.visibility, s.slot, m_strategy.slots);
                target *= visibility;
                if (m_strategy.params.counts)
                    s.expected +=
                        m_samples.expected(weight * target, visibility, weight > 0.f);
                if (m_lights.groups().evens())
                    target *=
                        evening(read_slot<UInt32D>(kept.light, s.slot, m_strategy.slots),
                                active && weight > 0.f);
                write_slot<FloatD>(s.target, s.slot, weight * target, m_strategy.items,
                                   true);
                s.slot += 1u;
            },
            "Direct light: targets");
        kept.target = state.target;
        counts.expected += state.expected;
        return kept;
    }

    /// |F| of a light's point
    FloatD light_target(const Vertex &vertex, const UInt32D &light,
                        const FloatD &inclusion, const UInt32D &slot, Kept &kept,
                        Mask active) const {
        Sample sample = m_samples.sample(vertex, light, inclusion, slot,
                                         /* target_only = */ true, active);
        if constexpr (!dr::is_jit_v<Float>)
            if (m_strategy.keeps_samples)
                kept.sample[slot] = sample;
        FloatD g = m_samples.target(sample.unoccluded());
        if (vertex.at.media) {
            bool segment = vertex.at.extent == Extent::Segment;
            auto from    = segment ? plain(sample.from) : vertex.at.p;
            auto far     = attenuation(vertex.at, dr::norm(plain(sample.p) - from));
            g            = dr::select(g > 0.f, g * far, 0.f); // else p is undefined
        }
        return g;
    }

    /// So that the light of dim groups is not noisier than that of others
    FloatD evening(const UInt32D &light, const Mask &active) const {
        const auto &groups = m_lights.groups();
        MaskD on           = plain(active);
        return groups.evening(groups.of_light(m_lights.tree(), light, on), on);
    }

    const Lights &m_lights;
    const Strategy &m_strategy;
    const Samples &m_samples;
};

} // namespace manylights
