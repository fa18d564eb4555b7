/* Drivers of a robot's motors, IMU and battery. They have those functions of hal.h that stm32f4/hal.c lacks. */
#ifndef DRIVERS_H
#define DRIVERS_H

/* hal_read_motors, hal_drive_motors, hal_enable_motors, hal_read_temperatures, hal_hazard, and: */
void start_motors(void);

/* hal_read_imu, hal_read_voltage, hal_sit, and: */
void start_sensors(void);

#endif
