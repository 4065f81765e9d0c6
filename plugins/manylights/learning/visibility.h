#pragma once

/**
 * Which lights can be seen from where, learnt from the shadow rays.
 *
 * Space is divided into cells. For each cell and each node of the tree a record counts, child
 * by child, the rays that were traced to lights below, and those that arrived. With the share
 * v of rays that arrive, the weights of children in the tree, H and the targets of stage 3
 * get the factor
 *
 *     f = max(sqrt(v), floor),    floor = .2 / sqrt(n), but .02 to .05, after n rays.
 *
 * The root is due to the visibility V being 0 or 1: the best density is sqrt(E[(F V)^2]) =
 * F sqrt(v). A factor is fixed before the number that it steers is drawn, so the image is
 * unbiased whatever the records hold. Kernels read factors that change between passes only,
 * so that the density of a light that BSDF sampling has hit sees the same ones.
 *
 * Records are found by a hash without a key: where two of them meet they share their counts,
 * and there is more noise instead of more memory. Counts are integers and added atomically,
 * so that their sums do not depend on an order.
 */

#include "manylights/base/recording.h"
#include "manylights/receiver/receiver.h"
#include <atomic>
#include <mitsuba/core/random.h>
#include <vector>

namespace manylights {

/// Smallest factor: bounds what a wrong record can do, and falls with the number of its rays
constexpr float kFloorOfFew = .05f, kFloorOfMany = .02f, kFloorFall = .2f;

/// Rays that a node is assumed to have had, of which the share arrived that is known of its parent
constexpr float kRaysOfParent = 16.f;

/// Cells are cubes with a side of so much of the distance from the camera, rounded down to a
/// power of two
constexpr float kCellGrowth = .3f;
/// Limits of the side, in parts of the scene's diagonal
constexpr float kLeastCell = 1e-4f, kLargestCell = .125f;

/// Receivers are moved by up to half a cell before they are looked up: with less, noise
/// changes visibly at borders
constexpr float kJitter = .5f;

/// What the size of cells depends on: the camera's position and the scene's diagonal
template <typename Float> struct CellSize {
    mitsuba::Point<Float, 3> camera;
    Float scene;
};

/// The least gain (\ref VisibilityTable::learn) for which it is worth looking visibility up
constexpr float kLeastGain = .02f;

/// Rays that a child is assumed to have had, and to have been seen by as its siblings are
constexpr float kPriorRays = .5f;

/// What is known of a node's children
template <typename Float> struct ChildVisibility {
    using UInt32 = dr::uint32_array_t<Float>;

    /// Factors of eight bits each, 0 if nothing is known
    UInt32 word;

    /// Factors of all children, in proportion
    Four<Float> factors() const {
        using U4 = dr::uint32_array_t<Four<Float>>;
        U4 bytes = U4(word, word >> 8u, word >> 16u, word >> 24u) & 255u;
        return dr::select(word != 0u, Four<Float>(bytes), 1.f);
    }

    /// The same, comparable with other nodes: `above` if nothing is known
    Four<Float> factors(const Float &above) const {
        return dr::select(word != 0u, factors() * (1.f / 255.f), Four<Float>(above));
    }

    /// The factor of one child, or `above` if nothing is known
    Float factor(const UInt32 &slot, const Float &above) const {
        return dr::select(word != 0u, Float((word >> (8u * slot)) & 255u) * (1.f / 255.f),
                          above);
    }
};

template <typename Float> class VisibilityTable {
public:
    using UInt32 = dr::uint32_array_t<Float>;
    using Int32  = dr::int32_array_t<Float>;
    using Mask   = dr::mask_t<Float>;
    using Storage =
        std::conditional_t<dr::is_jit_v<Float>, UInt32, dr::DynamicArray<UInt32>>;

    /// @param records  a power of two
    VisibilityTable(uint32_t records, const CellSize<Float> &size)
        : m_records(records), m_camera(size.camera), m_scene(size.scene),
          m_counting(true), m_factors(dr::zeros<Storage>(records)) {
        if constexpr (dr::is_jit_v<Float>) {
            m_counts = dr::zeros<UInt32>(records * kCounts);
            m_cells  = dr::zeros<UInt32>(records);
            dr::make_opaque(m_camera, m_scene, m_counting, m_factors, m_counts, m_cells);
        } else {
            m_counts = Counts(records * kCounts);
            m_cells  = Counts(records);
        }
    }

    /// The cell of a receiver, with borders that two random numbers move, so that they cannot
    /// be seen in the noise
    UInt32 cell(const Receiver<Float> &at, const UInt32 &random0,
                const UInt32 &random1) const {
        auto p = at.p;
        if (at.extent == Extent::Segment)
            p -= .5f * at.nearby() * at.wi;
        Float side = dr::clip(kCellGrowth * dr::norm(p - m_camera), kLeastCell * m_scene,
                              kLargestCell * m_scene);
        // 1 / side, both rounded to a power of two
        UInt32 level    = dr::reinterpret_array<UInt32>(side) >> 23u;
        Float scale     = dr::reinterpret_array<Float>((254u - level) << 23u);
        auto [a, b]     = mitsuba::sample_tea_32(random0, random1, 2);
        UInt32 shift[3] = { a & 0xffffu, a >> 16u, b & 0xffffu };
        UInt32 hash     = level;
        for (size_t i = 0; i < 3; ++i) {
            Float x = dr::fmadd(p.entry(i), scale, Float(shift[i]) * kJitter * 0x1p-16f);
            hash    = mix(hash ^ UInt32(dr::floor2int<Int32>(x)));
        }
        return mix(hash ^ face(at));
    }

    ChildVisibility<Float> children(const UInt32 &cell, const UInt32 &node) const {
        if constexpr (dr::is_jit_v<Float>)
            return { dr::gather<UInt32>(m_factors, record(cell, node)) };
        else
            return { m_factors.data()[record(cell, node)] };
    }

    /// A ray to a light below a child of a node was traced
    void count(const UInt32 &cell, const UInt32 &node, const UInt32 &slot,
               const Mask &arrived, const Mask &active) const {
        UInt32 place = record(cell, node),
               index = place * kCounts + 2u * slot +
                       dr::select(arrived, UInt32(1), UInt32(0));
        if constexpr (dr::is_jit_v<Float>) {
            // Without the copies that Dr.Jit makes of small arrays for each thread
            auto mode = ReduceMode::Local;
            dr::scatter_add(m_counts, UInt32(1), index, active, mode);
            dr::scatter_reduce(ReduceOp::Max, m_cells, cell, place, active, mode);
        } else if (active) {
            m_counts[index].fetch_add(1, std::memory_order_relaxed);
            uint32_t before = m_cells[place].load(std::memory_order_relaxed);
            while (before < cell && !m_cells[place].compare_exchange_weak(before, cell))
                ;
        }
    }

    /**
     * Go on with another rendering: with at least as many records, of which each starts with
     * what those knew that shared it, and cells as large as its camera deserves. Where these
     * are as large as before they are still known.
     */
    void prepare(uint32_t records, const CellSize<Float> &size) {
        m_camera = size.camera;
        m_scene  = size.scene;
        dr::make_opaque(m_camera, m_scene);
        if (records <= m_records)
            return;
        if constexpr (dr::is_jit_v<Float>) {
            auto repeat = [&](const UInt32 &array, uint32_t width) {
                UInt32 index = dr::arange<UInt32>(records * width);
                return dr::gather<UInt32>(array, index & (m_records * width - 1u));
            };
            m_factors = repeat(m_factors, 1);
            m_counts  = repeat(m_counts, kCounts);
            m_cells   = repeat(m_cells, 1);
            dr::make_opaque(m_factors, m_counts, m_cells);
        } else {
            auto repeat = [&](auto &&result, const auto &array, uint32_t width) {
                for (size_t i = 0; i < (size_t) records * width; ++i)
                    result[i] = (uint32_t) array[i & (m_records * width - 1)];
            };
            Storage factors = dr::empty<Storage>(records);
            Counts counts(records * kCounts), cells(records);
            repeat(factors.data(), m_factors.data(), 1);
            repeat(counts, m_counts, kCounts);
            repeat(cells, m_cells, 1);
            m_factors = std::move(factors);
            m_counts  = std::move(counts);
            m_cells   = std::move(cells);
        }
        m_records = records;
    }

    /// What was counted: for each record and child the rays that were blocked and those that
    /// arrived; then the cell of each record
    Storage counts() const {
        uint32_t size = m_records * kCounts;
        if constexpr (dr::is_jit_v<Float>) {
            Storage result = dr::zeros<Storage>(count_size());
            dr::scatter(result, m_counts, dr::arange<UInt32>(size));
            dr::scatter(result, m_cells, dr::arange<UInt32>(m_records) + size);
            return result;
        } else {
            Storage result = dr::empty<Storage>(count_size());
            for (size_t i = 0; i < count_size(); ++i)
                result.data()[i] = i < size ? m_counts[i] : m_cells[i - size];
            return result;
        }
    }

    size_t count_size() const { return (size_t) m_records * (kCounts + 1); }

    /// Go on from what was counted elsewhere, in a table of the same size
    void set_counts(const Storage &counts) {
        uint32_t size = m_records * kCounts;
        if constexpr (dr::is_jit_v<Float>) {
            m_counts = dr::gather<UInt32>(counts, dr::arange<UInt32>(size));
            m_cells  = dr::gather<UInt32>(counts, dr::arange<UInt32>(m_records) + size);
            dr::make_opaque(m_counts, m_cells);
        } else {
            for (size_t i = 0; i < count_size(); ++i)
                (i < size ? m_counts[i] : m_cells[i - size]) = counts.data()[i];
        }
    }

    /// Is \ref count to be called?
    const Mask &counting() const { return m_counting; }
    void set_counting(bool on) { m_counting = dr::opaque<Mask>(on); }

    /**
     * Make factors of the counts. Returns if they are worth it: with rays in proportion to F,
     * the variance of choosing a child is in proportion to sum(n v) sum(n), and
     * (sum(n sqrt(v)))^2 if the choice knows v. Their gain is the mean logarithm of the ratio
     * over the rays. A function that is recorded cannot read it: without gain all factors are 1.
     *
     * @param nodes        how many the tree has
     * @param parent_link  of a node: 4 * parent + slot, kNone for the root
     */
    template <typename ParentLink>
    bool learn(const UInt32 &nodes, const ParentLink &parent_link) {
        if constexpr (dr::is_jit_v<Float>) {
            Summary all = summarize(dr::arange<UInt32>(m_records), nodes, parent_link);
            dr::eval(all); // one kernel, and not one for each sum
            Float rays = dr::sum(all.rays), gain = dr::sum(all.gain);
            m_factors = all.word;
            if (is_recorded<Float>()) {
                m_factors &= gain / dr::maximum(rays, 1.f) >= kLeastGain;
                dr::eval(m_factors);
                return true;
            }
            dr::eval(rays, gain);
            return gain[0] / std::max(rays[0], 1.f) >= kLeastGain;
        } else {
            double rays = 0, gain = 0;
            for (uint32_t r = 0; r < m_records; ++r) {
                Summary record = summarize(r, nodes, parent_link);
                rays += record.rays;
                gain += record.gain;
                m_factors.data()[r] = record.word;
            }
            return (float) (gain / std::max(rays, 1.)) >= kLeastGain;
        }
    }

private:
    using Counts = std::conditional_t<dr::is_jit_v<Float>, UInt32,
                                      std::vector<std::atomic<uint32_t>>>;

    /// Two for each child: rays that were blocked, and rays that arrived
    static constexpr uint32_t kCounts = 8;

    /// The nodes of a cell follow each other, so that those near the root share cache lines
    UInt32 record(const UInt32 &cell, const UInt32 &node) const {
        return (cell + node) & (m_records - 1u);
    }

    static UInt32 mix(UInt32 x) {
        x *= 0x9e3779b1u;
        x ^= x >> 15u;
        x *= 0x2c1b3c6du;
        return x ^ (x >> 13u);
    }

    /// Which of six directions a surface faces, or that there is none
    static UInt32 face(const Receiver<Float> &at) {
        auto a = dr::abs(at.n);
        Mask x = a.x() > dr::maximum(a.y(), a.z()), y = a.y() > a.z();
        UInt32 axis = dr::select(x, UInt32(1), dr::select(y, UInt32(2), UInt32(3)));
        Float n     = dr::select(x, at.n.x(), dr::select(y, at.n.y(), at.n.z()));
        return dr::select(dr::squared_norm(at.n) > 0.f,
                          axis + dr::select(n < 0.f, UInt32(4), UInt32(0)), UInt32(0));
    }

    /// A record: its factors, eight bits each (0 if it is empty), its rays and their gain
    struct Summary {
        UInt32 word;
        Float rays, gain;
        DRJIT_STRUCT(Summary, word, rays, gain)
    };

    dr::Array<Float, kCounts> read(const UInt32 &record, const Mask &active) const {
        using Record = dr::Array<UInt32, kCounts>;
        if constexpr (dr::is_jit_v<Float>) {
            return dr::Array<Float, kCounts>(
                dr::gather<Record>(m_counts, record, active));
        } else {
            Record result;
            for (uint32_t i = 0; i < kCounts; ++i)
                result.entry(i) =
                    m_counts[record * kCounts + i].load(std::memory_order_relaxed);
            return dr::Array<Float, kCounts>(result);
        }
    }

    /// Rays of a record that arrived, and all of them
    static std::pair<Float, Float> rays_of(const dr::Array<Float, kCounts> &counts) {
        Float arrived = (counts[1] + counts[3]) + (counts[5] + counts[7]);
        return { arrived, arrived + (counts[0] + counts[2]) + (counts[4] + counts[6]) };
    }

    /// The share of the rays below a node that arrive; what is known of its parent counts as
    /// kRaysOfParent rays, and above the root all arrive
    template <typename ParentLink>
    Float arriving(const UInt32 &record, const UInt32 &nodes,
                   const ParentLink &parent_link, const Mask &active) const {
        struct State {
            UInt32 node;
            Float share, weight;
            Mask active;
            DRJIT_STRUCT(State, node, share, weight, active)
        };
        UInt32 cell;
        if constexpr (dr::is_jit_v<Float>)
            cell = dr::gather<UInt32>(m_cells, record, active);
        else
            cell = m_cells[record].load(std::memory_order_relaxed);
        State state{ (record - cell) & (m_records - 1u), Float(0.f), Float(1.f), active };
        state.active &= state.node < nodes;
        loop(
            state, [](const State &s) { return s.active; },
            [&](State &s) {
                auto [arrived, rays] =
                    rays_of(read((cell + s.node) & (m_records - 1u), s.active));
                s.share = dr::fmadd(s.weight, arrived / (rays + kRaysOfParent), s.share);
                s.weight *= kRaysOfParent / (rays + kRaysOfParent);
                UInt32 link = parent_link(s.node);
                s.active &= link != kNone;
                s.node = dr::select(s.active, link >> 2u, s.node);
            },
            "Visibility: parents");
        return state.share + state.weight;
    }

    template <typename ParentLink>
    Summary summarize(const UInt32 &record, const UInt32 &nodes,
                      const ParentLink &parent_link) const {
        auto counts = read(record, Mask(true));
        Float rays  = rays_of(counts).second, sum_v(0.f), sum_root(0.f);
        Mask known  = rays > 0.f;
        Float all   = arriving(record, nodes, parent_link, known);
        UInt32 word(0);
        for (uint32_t c = 0; c < 4; ++c) {
            Float hits = counts[2 * c + 1], n = hits + counts[2 * c],
                  v    = dr::fmadd(all, kPriorRays, hits) / (n + kPriorRays),
                  root = dr::sqrt(v);
            sum_v += n * v;
            sum_root += n * root;
            Float f = dr::maximum(
                root, dr::clip(kFloorFall * dr::rsqrt(n), kFloorOfMany, kFloorOfFew));
            word |= UInt32(dr::fmadd(f, 255.f, .5f)) << (8u * c);
        }
        Float gain = rays * dr::log(sum_v * rays / dr::square(sum_root));
        return { dr::select(known, word, UInt32(0)), rays, dr::select(known, gain, 0.f) };
    }

    uint32_t m_records;
    mitsuba::Point<Float, 3> m_camera;
    Float m_scene;
    Mask m_counting;
    Storage m_factors;
    mutable Counts m_counts;
    /// The cell of each record, the largest of those that share it
    mutable Counts m_cells;
};

} // namespace manylights
