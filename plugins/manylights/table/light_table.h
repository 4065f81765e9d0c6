#pragma once

/**
 * Scene emitters -> light table: reads every emitter once, on the host.
 *
 * Points, spots and area emitters of constant radiance become rows that the kernels can
 * evaluate without a virtual call; each triangle of an emissive mesh is a light of its
 * own. Of radiance that varies, the table has the mean over the triangle, sphere, disk or
 * cylinder; the emitter evaluates it at the point that was chosen. Other emitters of finite
 * extent (projectors, exotic shapes) are one light each, sampled through their own plugin
 * after they were selected. Emitters at infinity stay out of the table, and so do those
 * without power.
 *
 * A kind of light reads itself (`kinds/`); which emitter is of which kind is decided in
 * \ref LightTableReader.
 *
 * Emitters and textures are read through Mitsuba's traversal interface, since the classes
 * of its plugins have no headers.
 */

#include "mesh_lights.h"
#include "other_lights.h"
#include <optional>

namespace manylights {

template <typename Float, typename Spectrum> class LightTableReader {
public:
    MI_IMPORT_TYPES(Scene, Emitter, Shape, Mesh)
    using Table = HostTable<Float, Spectrum>;

    /// Read all emitters of a scene
    static Table read(const Scene *scene) {
        LightTableReader reader(scene);
        reader.m_builder.reserve();
        for (size_t i = 0; i < scene->emitters().size(); ++i)
            reader.add(scene->emitters()[i].get(), (uint32_t) i);
        return reader.m_builder.finish();
    }

    /// Read one emitter alone; none if its power depends on the others
    static std::optional<Table> read_one(const Scene *scene, uint32_t emitter) {
        LightTableReader reader(scene);
        reader.add(scene->emitters()[emitter].get(), emitter);
        if (reader.m_builder.has_unknown_powers())
            return {};
        return reader.m_builder.take_rows();
    }

private:
    explicit LightTableReader(const Scene *scene) : m_builder(scene) {}

    /// Hand an emitter to the reader of its class
    void add(const Emitter *emitter, uint32_t index) {
        m_builder.start(index);
        bool surface     = m_builder.has(mitsuba::EmitterFlags::Surface);
        bool directional = m_builder.has(mitsuba::EmitterFlags::DeltaDirection);
        if (emitter->sampling_weight() == 0)
            m_others.add_unsampled(emitter);
        else if (surface && directional) // Mitsuba never connects to it
            m_builder.count_unreachable();
        else if (surface && !emitter->shape())
            m_others.add_unattached(emitter);
        else if (surface)
            add_area(emitter, emitter->shape());
        else if (directional || m_builder.has(mitsuba::EmitterFlags::Infinite))
            m_others.add_infinite(emitter);
        else if (auto light = read_point(emitter))
            m_builder.add_light(*light);
        else
            m_others.add(emitter);
    }

    /// An emitter without a shape; none if no row can hold it
    std::optional<HostLight> read_point(const Emitter *emitter) const {
        std::string_view name = emitter->class_name();
        if (name == "PointLight")
            return PointLight::read(emitter);
        if (name == "SpotLight")
            return SpotLight::read(
                emitter, m_builder.has(mitsuba::EmitterFlags::SpatiallyVarying));
        return {};
    }

    /// An emitter on a shape, by the class of the shape
    void add_area(const Emitter *emitter, const Shape *shape) {
        Emission e     = EmissionReader<Float, Spectrum>::read(emitter);
        uint32_t first = m_builder.primitive_count();
        bool known     = emitter->class_name() == "AreaLight";
        if (known && shape->is_mesh()) {
            m_meshes.add(emitter, (const Mesh *) shape, e);
        } else {
            uint32_t light = m_builder.row_count();
            if (!known || !add_quadric(emitter, shape, e))
                m_others.add(emitter);
            m_builder.push_primitive(light);
        }
        m_builder.push_shape(shape, first);
    }

    /// False if the shape is no sphere, disk or cylinder
    bool add_quadric(const Emitter *emitter, const Shape *shape, const Emission &e) {
        std::string_view name = shape->class_name();
        if (name == "Sphere")
            m_builder.add_light(SphereLight::read(emitter, shape, e, m_images));
        else if (name == "Disk")
            m_builder.add_light(DiskLight::read(emitter, shape, e, m_images));
        else if (name != "Cylinder")
            return false;
        else if (auto light = CylinderLight::read(emitter, shape, e, m_images))
            m_builder.add_light(*light);
        else
            m_builder.add_only_hit();
        return true;
    }

    TableBuilder<Float, Spectrum> m_builder;
    ShownImages<Float, Spectrum> m_images;
    MeshLights<Float, Spectrum> m_meshes{ m_builder, m_images };
    OtherLights<Float, Spectrum> m_others{ m_builder };
};

} // namespace manylights
