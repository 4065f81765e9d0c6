#pragma once

/// The numbers of a scene's shapes, from 1 in the order of `scene.shapes()`.

#include "manylights/base/recording.h"
#include <memory>
#include <mitsuba/render/interaction.h>
#include <mitsuba/render/scene.h>
#include <unordered_map>
#include <vector>

namespace manylights {

template <typename Float, typename Spectrum> class ShapeNumbers {
public:
    MI_IMPORT_TYPES(Scene, Shape, ShapePtr)

    /// Of a scene, whose shapes may have changed
    void prepare(const Scene *scene) const {
        // Those of a function that is recorded are loaded before
        if (!is_recorded<Float>() || !m_table || !m_table->is_of(scene))
            std::atomic_store(&m_table, std::make_shared<Table>(scene));
    }

    MANYLIGHTS_TRAVERSE(m_table)

    /// The number of what was hit, of the instance if it is part of one; 0 for nothing
    UInt32 at(const Scene *scene, const SurfaceInteraction3f &si, Mask active) const {
        std::shared_ptr<Table> table = std::atomic_load(&m_table);
        if (!table || !table->is_of(scene)) {
            prepare(scene);
            table = std::atomic_load(&m_table);
        }
        active &= si.is_valid();
        ShapePtr shape = dr::select(si.instance != nullptr, si.instance, si.shape);
        if constexpr (dr::is_jit_v<Float>) {
            return dr::gather<UInt32>(table->numbers,
                                      dr::reinterpret_array<UInt32>(shape), active);
        } else {
            auto found = table->numbers.find(shape);
            return active && found != table->numbers.end() ? found->second : 0;
        }
    }

private:
    struct Table {
        /// Kept, so that no other has the address of one of them
        std::vector<mitsuba::ref<Shape>> shapes;
        /// By the number in the registry or the address
        std::conditional_t<dr::is_jit_v<Float>, UInt32,
                           std::unordered_map<const Shape *, uint32_t>>
            numbers;

        MANYLIGHTS_TRAVERSE(numbers)

        explicit Table(const Scene *scene) : shapes(scene->shapes()) {
            uint32_t number = 0;
            if constexpr (dr::is_jit_v<Float>) {
                std::vector<uint32_t> result(1);
                for (const auto &shape : shapes) {
                    uint32_t id = jit_registry_id(shape.get());
                    result.resize(std::max<size_t>(result.size(), id + 1));
                    result[id] = ++number;
                }
                numbers = dr::load<UInt32>(result.data(), result.size());
            } else {
                for (const auto &shape : shapes)
                    numbers[shape.get()] = ++number;
            }
        }

        /// Scalar variants ask for each sample: what a rendering was not prepared for is not
        /// compared in full
        bool is_of(const Scene *scene) const {
            const auto &others = scene->shapes();
            return shapes.size() == others.size() &&
                   (shapes.empty() ||
                    (shapes.front() == others.front() && shapes.back() == others.back()));
        }
    };

    /// Of the scene that was asked about last; threads may ask at the same time
    mutable std::shared_ptr<Table> m_table;
};

} // namespace manylights
