#pragma once

/**
 * The light table while it grows, emitter by emitter, and its bookkeeping: rows, bounds and
 * primitives, and what the scene has. It is handed what was read of
 * each light.
 */

#include "host_table.h"
#include "light_flux.h"
#include "triangle_chunks.h"
#include <mitsuba/core/logger.h>
#include <mitsuba/render/mesh.h>
#include <mitsuba/render/scene.h>

namespace manylights {

namespace dr = drjit;

/// Narrow spots matter if they have this share of the tree's flux: where they have less, their
/// noise is small, and lobes in place of harmonics slow all lights down
constexpr double kLeastBeams = .01;

template <typename Float, typename Spectrum> class TableBuilder {
public:
    MI_IMPORT_TYPES(Scene, Emitter, Shape, Mesh)
    using Table = HostTable<Float, Spectrum>;

    explicit TableBuilder(const Scene *scene) : m_scene(scene) {
        m_table.proportional.resize(scene->emitters().size(), false);
    }
    TableBuilder(const TableBuilder &) = delete;

    /// Memory for as many lights as there may be: growing would need twice as much
    void reserve() {
        size_t count = 0;
        for (const auto &emitter : m_scene->emitters()) {
            const Shape *shape = emitter->shape();
            count += shape && shape->is_mesh() ? ((const Mesh *) shape)->face_count() : 1;
        }
        m_table.rows.reserve(count);
        m_table.bounds.reserve(count);
        m_table.light_of_primitive.reserve(count);
    }

    /// All that follows belongs to this emitter
    void start(uint32_t emitter) {
        m_emitter = emitter;
        m_flags   = m_scene->emitters()[emitter]->flags();
    }

    /// Has the current emitter this flag?
    bool has(mitsuba::EmitterFlags flag) const { return has_flag(m_flags, flag); }

    /// The table, all of whose emitters have been read
    Table finish() {
        estimate_unknown_powers();
        finish_bounds();
        warn_of_invalid_lights();
        return std::move(m_table);
    }

    /// The rows alone, in no order and without weights
    Table take_rows() { return std::move(m_table); }

    bool has_unknown_powers() const { return m_unknown_powers; }
    uint32_t row_count() const { return (uint32_t) m_table.rows.size(); }
    uint32_t primitive_count() const {
        return (uint32_t) m_table.light_of_primitive.size();
    }

    // ------------------------------------------------------------------------ Lights

    /// Brightness of a light of the current emitter whose power cannot be found: it will get
    /// the mean of the others
    float unknown_brightness() {
        m_unknown_powers = true;
        return kUnknownPower;
    }

    /// Lights without power, and degenerate ones, stay out
    void add_light(const HostLight &light) {
        auto [row, bounds] = light;
        row.tag |= m_emitter << kTagEmitterShift;
        ++m_table.light_count;
        LightKind kind = kind_of(row);
        bool hit_able  = has(mitsuba::EmitterFlags::Surface);
        bool by_plugin = hit_able && !(row.tag & kTagTabulated);
        m_table.needs_emitter_eval |= by_plugin;
        m_table.can_be_hit |= hit_able;
        double power = usable_power(row, bounds);
        note_invalid(!is_valid_power(power));
        if (!is_valid_power(power) || power == 0) {
            m_only_hit = by_plugin; // black as far as the quadrature saw
            if (by_plugin)
                note_only_hit();
            return;
        }
        m_table.proportional[m_emitter] = row.tag & kTagTabulated;
        bool beam   = kind == LightKind::Spot && SpotLight::is_narrow(row),
             known  = row.brightness != kUnknownPower;
        double flux = known ? light_flux(row, /* beams = */ false) : 0;
        (beam ? m_beam_flux : m_other_flux) += flux;
        m_largest_flux = std::max(m_largest_flux, flux);
        m_table.kinds.insert(kind);
        m_table.rows.push_back(row);
        m_table.bounds.push_back(bounds);
    }

    /// Add `count` triangles and their primitives, each read by `read(index, row, bounds)`, on
    /// all threads
    template <typename F> void add_triangles(size_t count, const F &read) {
        size_t first     = m_table.rows.size();
        auto read_tagged = [&](size_t i, LightRow &row, LightBounds &bounds) {
            read(i, row, bounds);
            row.tag |= m_emitter << kTagEmitterShift;
        };
        std::vector<TriangleChunk> chunks = append_triangles(m_table, count, read_tagged);
        bool complete                     = m_table.rows.size() == first + count,
             any                          = m_table.rows.size() > first;
        m_table.light_count += (uint32_t) count;
        m_table.can_be_hit |= count > 0;
        if (any)
            m_table.kinds.insert(LightKind::Triangle);
        m_table.proportional[m_emitter] = complete;
        bool by_plugin                  = false;
        for (const TriangleChunk &chunk : chunks) {
            by_plugin |= chunk.by_plugin;
            m_other_flux += chunk.flux;
            m_largest_flux = std::max(m_largest_flux, chunk.largest);
            note_invalid(chunk.invalid);
        }
        m_table.needs_emitter_eval |= by_plugin;
        if (by_plugin && !any)
            note_only_hit();
    }

    /// An emitter without a place; `e`: what it emits, if that is known
    void add_infinite(const Emitter *emitter, const Emission &e = {}) {
        ++m_table.light_count;
        m_table.infinite.push_back(emitter);
        note_invalid(!is_valid_power(e.brightness));
        m_infinite_flux = std::max(m_infinite_flux, (double) e.brightness);
        m_table.proportional[m_emitter] = e.tabulated && e.brightness > 0;
    }

    /// Count a light that only rays can find; no point is ever chosen on it
    void add_only_hit() {
        note_only_hit();
        count_hit_able();
        m_only_hit = true;
    }

    /// Count a light that nothing finds
    void count_unreachable() { ++m_table.light_count; }

    /// Count a light that is left to rays on purpose: without a warning
    void count_hit_able() {
        ++m_table.light_count;
        m_table.needs_emitter_eval = m_table.can_be_hit = true;
    }

    /// The emission of the current emitter's lights changes each in its own way
    void set_not_proportional() { m_table.proportional[m_emitter] = false; }

    // -------------------------------------------------------------------- Primitives

    /// The primitive is the light that was added since, if any
    void push_primitive(uint32_t next_light) {
        bool added = m_table.rows.size() > next_light;
        m_table.light_of_primitive.push_back(added ? next_light
                                                   : (m_only_hit ? kOnlyHit : kNone));
        m_only_hit = false;
    }

    /// All primitives that were pushed from number `first` on are those of `shape`
    void push_shape(const Shape *shape, uint32_t first) {
        m_table.shapes.push_back({ shape, first, primitive_count() - first });
    }

    /// Rays alone find all primitives of an emitter's shapes
    void push_only_hit(const Emitter *emitter) {
        uint32_t first = primitive_count();
        m_only_hit     = false;
        m_table.light_of_primitive.push_back(kOnlyHit);
        if (emitter->shape())
            return push_shape(emitter->shape(), first);
        // Some shapes (ellipsoidsmesh) do not tell their emitter about themselves
        for (const auto &shape : m_scene->shapes())
            if (shape->emitter() == emitter)
                push_shape(shape.get(), first);
    }

    /// What users know an emitter by
    static std::string name_of(const Emitter *emitter) {
        const Shape *shape = emitter->shape();
        return std::string(shape ? shape->id() : emitter->id());
    }

private:
    /// Note lights of the current emitter whose power is not a finite number >= 0
    void note_invalid(uint32_t count) {
        if (count > 0 && m_invalid == 0)
            m_first_invalid = m_emitter;
        m_invalid += count;
    }

    /// Note that no point is ever chosen on the current emitter
    void note_only_hit() {
        if (m_table.only_hit++ == 0)
            m_table.first_only_hit = name_of(m_scene->emitters()[m_emitter].get());
    }

    // ------------------------------------------------------------------------ Finish

    /// Give lights of unknown power the mean of the others, which is right in any unit
    void estimate_unknown_powers() {
        if (!m_unknown_powers)
            return;
        size_t known = 0;
        for (const LightRow &row : m_table.rows)
            known += row.brightness != kUnknownPower;
        double mean    = known ? (m_beam_flux + m_other_flux) / (double) known : 1.;
        m_largest_flux = std::max(m_largest_flux, mean);
        for (LightRow &row : m_table.rows)
            if (row.brightness == kUnknownPower)
                row.brightness = (float) (mean / (4 * kPi));
        // It depends on all the others
        m_table.proportional.assign(m_table.proportional.size(), false);
    }

    /// Fluxes in units of the largest one; and where narrow spots do not matter, unit axes and
    /// the weights of spots that go with them (see LightBounds)
    void finish_bounds() {
        m_table.beams = m_beam_flux > kLeastBeams * (m_other_flux + m_beam_flux);
        m_table.scale = flux_scale(m_largest_flux > 0 ? m_largest_flux : m_infinite_flux);
        for_chunks(m_table.rows.size(), [&](size_t, size_t begin, size_t end) {
            for (size_t i = begin; i < end; ++i) {
                LightBounds &bounds = m_table.bounds[i];
                bounds.flux = scaled_flux(light_flux(m_table.rows[i], m_table.beams),
                                          m_table.scale);
                if (m_table.beams)
                    continue;
                float length = norm(bounds.axis);
                for (float &coordinate : bounds.axis)
                    coordinate /= length > 0 ? length : 1.f;
            }
        });
    }

    /// Without a word they would just be missing from the image
    void warn_of_invalid_lights() const {
        if (m_invalid == 0)
            return;
        std::string id = name_of(m_scene->emitters()[m_first_invalid].get());
        Log(mitsuba::Warn,
            "Lights that are never chosen: %u of %u. Their power must not be negative, "
            "and power and position must be finite. The first one belongs to \"%s\".",
            m_invalid, m_table.light_count, id);
    }

    /// Stands for a power that could not be found, and is too small to count
    static constexpr float kUnknownPower = std::numeric_limits<float>::min();

    const Scene *m_scene;
    Table m_table;
    /// Index of the emitter that is being read; did its last light turn out to be unsampled?
    uint32_t m_emitter = 0;
    bool m_only_hit    = false;
    /// Flags of that emitter: asking for them makes a variable in JIT variants
    uint32_t m_flags = 0;
    /// Is there a light with \ref kUnknownPower?
    bool m_unknown_powers = false;
    /// Sums of the fluxes of narrow spots and of all else, the largest of all, and the largest
    /// irradiance or radiance of lights without a place
    double m_beam_flux = 0, m_other_flux = 0, m_largest_flux = 0, m_infinite_flux = 0;
    /// Lights that \ref note_invalid noted, and the index of the first one's emitter
    uint32_t m_invalid = 0, m_first_invalid = 0;

    static constexpr const char *ClassName = "LightTable"; // for log messages
};

} // namespace manylights
