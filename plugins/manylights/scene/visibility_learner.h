#pragma once

/**
 * What rays have taught about the visibility of a scene's lights (visibility.h), from one
 * rendering to the next if that is wanted.
 */

#include "fingerprint.h"
#include "manylights/learning/visibility.h"
#include "scene_shapes.h"
#include <memory>

namespace manylights {

template <typename Float, typename Spectrum> class VisibilityLearner {
public:
    using Scene  = mitsuba::Scene<Float, Spectrum>;
    using Shape  = mitsuba::Shape<Float, Spectrum>;
    using Table  = VisibilityTable<dr::detached_t<Float>>;
    using Counts = typename Table::Storage;

    /**
     * Learn from now on: anew, or in addition to what was kept if the shapes are still the same.
     * The table has 512 records for each of `nodes`, about as many as there are cells in sight,
     * but no more than `samples` are expected, and at most 42 MB.
     */
    void start(const Scene *scene, const CellSize<dr::detached_t<Float>> &size,
               uint32_t nodes, double samples, bool keep) {
        uint32_t records = record_count(std::min(512. * nodes, samples));
        Fingerprint<Float> shapes(0);
        if (keep)
            for_each_shape(scene, [&](const Shape *shape) { shapes.add_emitter(shape); });
        if (keep && m_table && shapes.same_places(m_shapes)) {
            m_table->prepare(records, size);
        } else {
            m_table    = std::make_unique<Table>(records, size);
            m_shapes   = std::move(shapes);
            m_worth_it = false;
            m_shapes.hold();
        }
    }

    /// Records of a table that wants so many
    static uint32_t record_count(double wanted) {
        uint32_t records = 1u << 12;
        while (records < kMostRecords && records < wanted)
            records *= 2;
        return records;
    }

    /// Count the rays that follow, or use what was learnt so far, if that is worth it
    void count(bool on) {
        if (!m_table)
            return;
        m_table->set_counting(on);
        m_used = on || m_worth_it;
    }

    /// Make factors of the counts
    template <typename Tree> void learn(const Tree &tree) {
        m_worth_it = m_table->learn(
            tree.node_count, [&](const auto &node) { return tree.parent_link(node); });
    }

    /// What was counted, empty if there is no table
    Counts counts() const { return m_table ? m_table->counts() : Counts(); }
    /// How many numbers they are
    size_t count_size() const { return m_table ? m_table->count_size() : 0; }
    template <typename Tree> void set_counts(const Tree &tree, const Counts &counts) {
        m_table->set_counts(counts);
        learn(tree);
    }

    void stop(bool keep) {
        count(false);
        if (keep)
            return;
        m_used = m_worth_it = false;
        m_table.reset();
    }

    /// What kernels use; null if that is nothing
    const Table *in_use() const { return m_used ? m_table.get() : nullptr; }

private:
    static constexpr uint32_t kMostRecords = 1u << 20;

    std::unique_ptr<Table> m_table;
    /// The shapes where it was learnt
    Fingerprint<Float> m_shapes{ 0 };
    bool m_used = false, m_worth_it = false;
};

} // namespace manylights
