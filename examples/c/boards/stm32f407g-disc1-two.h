/* The same board with another memory map. */
#include "stm32f407g-disc1.h"
